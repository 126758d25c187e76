"""`python evaluate.py checkpoint=<path>`: the collision table of a trained model."""

from __future__ import annotations

import functools
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
from hno.cli.results import Results, config_hash, plain, write_json
from hno.cli.summary import report, show
from hno.data.labels import Request, labels_for, safe_labels_for
from hno.evaluation.closed_loop import TypeRow, play, table_of
from hno.evaluation.episodes import EPISODES, episodes
from hno.evaluation.rollout import Disturbance, control_steps, rollout
from hno.games import Game
from hno.games.grid import parse_types
from hno.operators.checkpoint import OperatorPolicy, load_operator
from hno.report.picture import PlotsMissingError, rollout_picture, typical
from hno.types import Extremal

log = logging.getLogger(__name__)


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
        log.error("Say which checkpoint to evaluate: python evaluate.py checkpoint=<path to best.ckpt>")
        return False
    folder = Path(HydraConfig.get().runtime.output_dir)
    results = Results(
        folder / "results.json",
        {"checkpoint": config.checkpoint, "config_hash": config_hash(config), "config": plain(config)},
    )
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
    check_evaluation(policy.game, config)
    types = types_to_evaluate(config.theta, policy, config.unseen)
    cache = cache_folder(config.cache)
    labels = solve_tests(policy.game, types, config, cache, config.workers, results)
    evaluate_policy(policy, labels, config, results)
    results.update(status="finished")


def types_to_evaluate(
    text: str, policy: OperatorPolicy, unseen: Sequence[Sequence[float]] = ()
) -> list[tuple[float, ...]]:
    """Player types from "default", a named grid, or a list such as "1,1;2.5,4".

    Default are the labelled types, and those of `unseen` that lie in the game's type box.

    Raises:
        ValueError: none of these, or entries that are not one finite number per player.
    """
    game = policy.game
    if text == "default":
        own = [theta for theta in unseen if len(theta) == game.players]
        inside = [theta for theta in own if bool(game.type_box.contains(torch.tensor(theta)))]
        return list(dict.fromkeys([*policy.operator.seen_types, *game.validate_types(inside)]))
    return parse_types(game, text, also=("default",))


def solve_tests(
    game: Game,
    types: Sequence[tuple[float, ...]],
    settings: DictConfig,
    cache: Path,
    workers: int | None,
    results: Results,
) -> list[Extremal]:
    """Labels of the test starts of every type, from the cache or solved."""
    requests = [Request(theta, settings.starts, settings.seed, "test", float(settings.widen)) for theta in types]
    solver = functools.partial(safe_labels_for, clearance=settings.clearance) if settings.safe else labels_for
    labels, seconds = solver(game, requests, cache, workers=workers, report=label_progress())
    results.time("test_labels", seconds)
    results.update(test_seed=settings.seed)
    return labels


def evaluate_policy(
    policy: OperatorPolicy, labels: Sequence[Extremal], settings: DictConfig, results: Results
) -> list[TypeRow]:
    """Roll out from the starts of the labels, put the table into the results and draw an episode."""
    began = time.perf_counter()
    disturbance = Disturbance(settings.noise, settings.delay, settings.seed)
    played = play(policy.game, policy, labels, settings.dt, disturbance)
    table = table_of(played, labels, policy.operator.seen_types, settings.clearance)
    results.time("evaluation", time.perf_counter() - began)
    write_json(results.path.parent / EPISODES, episodes(policy.game, played, labels, settings.clearance))
    results.update(episodes=EPISODES)
    conditions = {name: settings[name] for name in ("clearance", "dt", "widen", "noise", "delay")}
    results.update(**conditions, table=[row._asdict() for row in table])
    draw(policy, labels[0], results.path.parent / "rollout.png", settings.dt)
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


def check_evaluation(game: Game, settings: DictConfig) -> None:
    """Raise ValueError for entries that make no evaluation of the game."""
    for name, least in (("starts", 1), ("seed", 0), ("workers", 1), ("delay", 0)):
        value = settings.get(name)
        if value is not None and not (isinstance(value, int) and value >= least):
            raise ValueError(f"{name} must be a whole number of at least {least}; got {value!r}.")
    for name in ("clearance", "dt", "noise", "widen"):
        value = settings[name]
        if not (isinstance(value, (int, float)) and math.isfinite(value) and value >= 0):
            raise ValueError(f"{name} must be a finite number of at least 0; got {value!r}.")
    if settings.widen == 0:
        raise ValueError("widen must be a positive number; got 0.")
    if not isinstance(settings.safe, bool):
        raise ValueError(f"safe must be true or false; got {settings.safe!r}.")
    control_steps(game, settings.dt)
