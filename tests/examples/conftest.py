from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch

from hno.data import Collocation, GameData, LabelPlan, make_sampler, sources
from hno.data.curriculum import Curriculum
from hno.games import Game, games
from hno.losses import Objective, Scales, losses, make_objective
from hno.operators import Architecture, Choice, ValueOperator, make_operator, networks
from hno.pontryagin import Solver
from hno.training import Fitted, Settings, fit
from hno.training.module import TrainingModule
from hno.training.optimizers import optimizers
from tests.cli.conftest import clean_globals, command, no_pages
from tests.export.conftest import exported

__all__ = ["clean_globals", "command", "exported", "no_pages"]

FOLDER = Path(__file__).parents[2] / "examples"
LABELS = {"value": {}, "costate": {}}
"""The terms that compare with labels."""
SMALL = Choice("deeponet", {"width": 32, "depth": 3})
MESH = Solver(extra_nodes=20)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, str]]:
    """The examples' package as `pip install ./examples` leaves it; its entry points by group.

    What has been registered is forgotten after the test.
    """
    project = tomllib.loads((FOLDER / "pyproject.toml").read_text())["project"]
    lines = [
        line
        for group, points in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {target}" for name, target in points.items()))
    ]
    metadata = tmp_path / "site" / "hno_examples-0.1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: hno-examples\nVersion: 0.1.0\n")
    (metadata / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(metadata.parent)
    for registry in (games, networks, losses, sources, optimizers):
        registry.names()
        monkeypatch.setattr(registry, "_classes", dict(registry._classes))
        monkeypatch.setattr(registry, "_discovered", False)
    return project["entry-points"]


class Trained(NamedTuple):
    """What a short training left behind."""

    operator: ValueOperator
    data: GameData
    fitted: Fitted
    before: float
    """Loss of a fixed batch before the training."""
    after: float
    """The same after it."""


Train = Callable[..., Trained]


@pytest.fixture
def train(cache: Path, tmp_path: Path) -> Train:
    """Train an operator of a game for seconds."""

    def run(
        game: Game,
        types: Sequence[tuple[float, ...]],
        *,
        terms: Mapping[str, Mapping[str, Any]] = LABELS,
        weights: Mapping[str, float] | None = None,
        network: Choice = SMALL,
        sampler: Mapping[str, Any] | None = None,
        optimizer: Mapping[str, Any] | None = None,
        trajectories: int = 4,
        steps: int = 100,
        record: Callable[[Game, Architecture], Mapping[str, Any]] | None = None,
    ) -> Trained:
        torch.manual_seed(0)
        architecture = Architecture(network=network)
        operator = make_operator(game, architecture)
        objective = make_objective(terms, weights or dict.fromkeys(terms, 1.0))
        data = GameData(
            game,
            objective.streams(exact_terminal=operator.meets_terminal),
            labels=LabelPlan(types=types, trajectories=trajectories, validation=1, cache=cache, solver=MESH, workers=1),
            collocation=Collocation(make_sampler(sampler or {"box": 1.0}), Curriculum(0, 0)),
            batch_sizes={"bvp": 256, "interior": 64, "terminal": 64},
        )
        data.setup("fit")
        operator.set_scales(Scales(*data.scales()))
        before = loss(operator, objective, data)
        settings = Settings(
            steps=steps, optimizer=optimizer or {"name": "soap"}, validate_every=steps, dt=0.1, accelerator="cpu"
        )
        content = record(game, architecture) if record else None
        fitted = fit(operator, objective, data, settings, tmp_path / "run", validation=[], record=content)
        return Trained(operator, data, fitted, before, loss(operator, objective, data))

    return run


def loss(operator: ValueOperator, objective: Objective, data: GameData) -> float:
    """The weighted loss of a batch that no training step sees."""
    module = TrainingModule(operator, objective)
    return objective.total(module.losses(data.batch(10**6))).item()
