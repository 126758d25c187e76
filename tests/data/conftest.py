from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

from hno.data import Collocation, GameData, LabelPlan, make_sampler
from hno.data import labels as label_data
from hno.data.curriculum import Curriculum
from hno.games import Game, make
from hno.pontryagin.solve import Solver
from hno.types import Extremal
from tests.fakes import fake_labels, fake_solve

TYPES = ((1.0, 1.0), (5.0, 5.0), (1.0, 5.0), (2.0, 3.0))
WIDENING = Curriculum(0, 10)
MIXED = {"box": 0.4, "band": 0.3, "labels": 0.3}
SIZES: Mapping[str, int | None] = {"bvp": 32, "interior": 64, "terminal": 16}

MakeData = Callable[..., GameData]
Asked = Counter[tuple[float, ...]]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    """A solver that answers at once, and how many rows of each type were asked of it."""
    count: Asked = Counter()

    def answer(game: Game, x0: Tensor, theta: Tensor, settings: Solver, *, all_equilibria: bool) -> Extremal:
        count[tuple(theta[0].tolist())] += len(x0)
        return fake_solve(game, x0, theta)

    monkeypatch.setattr(label_data, "solve", answer)
    return count


@pytest.fixture
def make_data() -> MakeData:
    """A datamodule of four trajectories per type, one of them held out, on labels that were not solved."""

    def build(
        game: Game | None = None,
        *,
        streams: Collection[str] = ("bvp", "interior", "terminal"),
        seed: int = 0,
        batch_sizes: Mapping[str, int | None] = SIZES,
        curriculum: Curriculum = WIDENING,
        sampler: Mapping[str, float] = MIXED,
        interior_types: str = "labelled",
        **plan: Any,
    ) -> GameData:
        game = game if game is not None else make("narrow_road")
        labels = {"types": TYPES, "trajectories": 3, "validation": 1, "cache": Path("unused")} | plan
        collocation = Collocation(make_sampler(sampler), curriculum, interior_types)
        data = GameData(game, streams, seed, LabelPlan(**labels), collocation, batch_sizes)
        data.extremals = [fake_labels(game, theta, seed=row) for row, theta in enumerate(data.type_list)]
        data.setup("fit")
        return data

    return build
