"""`python evaluate.py checkpoint=<path>`: the collision table of a trained model."""

from __future__ import annotations

import itertools
import logging
import math
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from hno.cli.build import cache_folder
from hno.cli.config import run_command
from hno.cli.logs import label_progress, send_lightning_to_hydra
from hno.cli.results import Results, config_hash
from hno.cli.summary import report, show
from hno.data.generate import Request, labels_for
from hno.evaluation.closed_loop import TypeRow, collision_table
from hno.evaluation.rollout import control_steps, rollout
from hno.games import Game
from hno.operators.checkpoint import OperatorPolicy, load_operator
from hno.report.picture import PlotsMissingError, rollout_picture, typical
from hno.types import Extremal

log = logging.getLogger(__name__)

GRIDS = {"grid5": 5, "grid9": 9}
"""Named grids over the type box: points per player."""
UNSEEN = ((1.0, 2.0), (2.0, 2.0), (2.0, 4.0), (4.0, 5.0))
"""Types that are evaluated by default beside those of the training, where the game has them."""


def main() -> None:
    """Entry point."""
    run_command("evaluate", evaluate)


def evaluate(config: DictConfig) -> bool:
    """Evaluate one checkpoint and write results.json into the run's own folder.

    Returns:
        Whether it succeeded. A failure has been logged and is in results.json.
    """
    send_lightning_to_hydra()
    if OmegaConf.is_missing(config, "checkpoint"):
        log.error("Say which checkpoint to evaluate: python evaluate.py checkpoint=<path to last.ckpt>")
        return False
    folder = Path(HydraConfig.get().runtime.output_dir)
    results = Results(folder / "results.json", {"checkpoint": config.checkpoint, "config_hash": config_hash(config)})
    try:
        _run(config, results)
    except Exception as error:
        results.update(status="failed", reason=f"{type(error).__name__}: {error}")
        report(error)
        return False
    except (KeyboardInterrupt, SystemExit):  # Lightning turns the one into the other
        results.update(status="failed", reason="interrupted")
        raise
    show(results.content, folder)
    return True


def _run(config: DictConfig, results: Results) -> None:
    policy = OperatorPolicy(load_operator(config.checkpoint, config.expected_game))
    operator = policy.operator
    results.update(**operator.names())
    types = parse_types(config.theta, policy)
    settings = {name: config[name] for name in ("starts", "seed", "clearance", "dt")}
    evaluate_policy(policy, types, cache_folder(config.cache), config.workers, results, **settings)
    results.update(status="finished")


def parse_types(text: str, policy: OperatorPolicy) -> list[tuple[float, ...]]:
    """Player types from "default", a named grid, or a list such as "1,1;2.5,4".

    Raises:
        ValueError: none of these, or entries that are not one finite number per player.
    """
    game = policy.game
    if text == "default":
        unseen = [theta for theta in UNSEEN if game.players == 2 and bool(game.type_box.contains(torch.tensor(theta)))]
        return list(dict.fromkeys([*policy.operator.seen_types, *unseen]))
    if text in GRIDS:
        corners = zip(game.type_box.lo.tolist(), game.type_box.hi.tolist(), strict=True)
        steps = GRIDS[text] - 1
        axes = [[lo + (hi - lo) * k / steps for k in range(steps + 1)] for lo, hi in corners]
        return game.validate_types(list(itertools.product(*axes)))
    try:
        types = [[float(entry) for entry in part.split(",")] for part in str(text).split(";")]
    except ValueError as error:
        known = ", ".join(("default", *GRIDS))
        raise ValueError(f"theta must be one of {known}, or a list such as '1,1;2.5,4'; got {text!r}.") from error
    return game.validate_types(types)


def evaluate_policy(
    policy: OperatorPolicy,
    types: Sequence[tuple[float, ...]],
    cache: Path,
    workers: int | None,
    results: Results,
    *,
    starts: int,
    seed: int,
    clearance: float,
    dt: float,
) -> list[TypeRow]:
    """Solve the test starts where the cache lacks them, roll out, and put the table into the results."""
    check_evaluation(policy.game, starts, clearance, dt)
    requests = [Request(theta, starts, seed, "test") for theta in types]
    labels, seconds = labels_for(policy.game, requests, cache, workers=workers, progress=label_progress())
    results.time("test_labels", seconds)
    began = time.perf_counter()
    table = collision_table(policy.game, policy, labels, policy.operator.seen_types, clearance, dt)
    results.time("evaluation", time.perf_counter() - began)
    results.update(clearance=clearance, dt=dt, test_seed=seed, table=[row._asdict() for row in table])
    draw(policy, labels[0], results.path.parent / "rollout.png", dt)
    return table


def draw(policy: OperatorPolicy, found: Extremal, path: Path, dt: float, episodes: int = 15) -> None:
    """Draw a typical episode from the first starts of a label set; without matplotlib, say so."""
    starts, theta = found.x[:episodes, 0].float(), found.theta[:episodes].float()
    played = rollout(policy.game, policy, starts, theta, dt)
    names = policy.operator.names()
    try:
        rollout_picture(policy.game, played, theta, path, " / ".join(names.values()), typical(played))
    except PlotsMissingError as error:
        log.info("No picture: %s", error)


def check_evaluation(game: Game, starts: int, clearance: float, dt: float) -> None:
    """Raise ValueError for sizes that make no evaluation of the game."""
    if starts < 1:
        raise ValueError(f"starts must be at least 1 per type; got {starts}.")
    if not (math.isfinite(clearance) and clearance >= 0):
        raise ValueError(f"clearance must be a finite distance of at least 0 m; got {clearance}.")
    control_steps(game, dt)
