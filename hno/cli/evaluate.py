"""`python evaluate.py checkpoint=<path>`: how safe trained models are, and where they err."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from hno.cli.build import cache_folder
from hno.cli.checks import finite_number, flag, whole_number
from hno.cli.config import run_command
from hno.cli.logs import send_lightning_to_hydra
from hno.cli.media import draw_typical
from hno.cli.results import Results, config_hash, plain, write_json
from hno.cli.sections import check_sections, evaluation_of, run_sections, table_condition
from hno.cli.starts import TestLabels
from hno.cli.summary import report, show
from hno.control.rollout import control_steps
from hno.evaluation.closed_loop import CollisionTable, play
from hno.evaluation.comparison import PairedComparison, check_same_game
from hno.evaluation.episodes import EPISODES, episodes
from hno.evaluation.sections import Evaluation
from hno.games import Game
from hno.games.grid import parse_types
from hno.training.checkpoint import LearnedPolicy, load_policy
from hno.types import Extremal

log = logging.getLogger(__name__)


def main() -> None:
    """Entry point."""
    run_command("evaluate", evaluate)


def evaluate(config: DictConfig) -> bool:
    """Evaluate checkpoints and write results.json into the run's own folder.

    Returns:
        Whether it succeeded. A failure has been logged and is in results.json.
    """
    send_lightning_to_hydra()
    if OmegaConf.is_missing(config, "checkpoint"):
        log.error("Say which checkpoint to evaluate: python evaluate.py checkpoint=<path to best.ckpt>")
        return False
    folder = Path(HydraConfig.get().runtime.output_dir)
    head = {"checkpoint": checkpoints_of(config)[0], "config_hash": config_hash(config), "config": plain(config)}
    results = Results(folder / "results.json", head)
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


def checkpoints_of(config: DictConfig) -> list[str]:
    """Paths of the models: one, or several of a list; an empty list names none."""
    several = OmegaConf.is_list(config.checkpoint) and len(config.checkpoint) > 0
    return [str(path) for path in config.checkpoint] if several else [str(config.checkpoint)]


def _run(config: DictConfig, results: Results) -> None:
    paths = checkpoints_of(config)
    policies = [load_policy(path, config.expected_game) for path in paths]
    game = policies[0].game
    results.update(**policies[0].names(), seed=policies[0].provenance.seed)
    check_same_game(paths, [policy.game for policy in policies])
    check_evaluation(game, config)
    chosen = [types_to_evaluate(config.theta, policy, config.unseen) for policy in policies]
    types = list(dict.fromkeys(theta for own in chosen for theta in own))
    settings = plain(config)
    solve = TestLabels(game, types, settings, cache_folder(config.cache), config.workers)
    evaluations = [
        evaluation_of(path, policy, types, settings, solve) for path, policy in zip(paths, policies, strict=True)
    ]
    for evaluation in evaluations:
        check_sections(evaluation)
    labels = solve_tests(solve, evaluations[0], results)
    models, played = list[dict[str, Any]](), list[Evaluation]()
    for policy, evaluation in zip(policies, evaluations, strict=True):
        log.info("evaluation of %s", evaluation.name)
        found, table = (assess if models else evaluate_policy)(evaluation, labels, results)
        played.append(found)
        names = {**policy.names(), "seed": policy.provenance.seed}
        models.append({"checkpoint": evaluation.name, **names, "table": table})
        for name, content in run_sections(found, results):
            models[-1][name] = content
            results.update(**models[0])
    if len(models) > 1:
        results.update(models=models, comparison=PairedComparison().compute(played))
    results.update(status="finished")


def types_to_evaluate(
    text: str, policy: LearnedPolicy, unseen: Sequence[Sequence[float]] = ()
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
        return list(dict.fromkeys([*policy.types, *game.validate_types(inside)]))
    return parse_types(game, text, also=("default",))


def solve_tests(solve: TestLabels, evaluation: Evaluation, results: Results) -> list[Extremal]:
    """Labels of the test starts of every type, from the cache or solved."""
    labels = solve(evaluation.condition)
    results.time("test_labels", solve.seconds)
    results.update(test_seed=evaluation.condition.disturbance.seed)
    return labels


Assessed = tuple[Evaluation, list[dict[str, Any]]]
"""An evaluation with its episodes, and the rows of its table."""


def evaluate_policy(evaluation: Evaluation, labels: Sequence[Extremal], results: Results) -> Assessed:
    """Play from the starts of the labels, put the table into the results, keep some episodes and draw one."""
    found, table = assess(evaluation, labels, results)
    folder, game = results.path.parent, found.game
    kept = episodes(game, found.played, labels, found.clearance)
    write_json(folder / EPISODES, kept)
    conditions = {name: found.options[name] for name in ("clearance", "dt", "widen", "noise", "delay")}
    results.update(**conditions, constraint_unit=game.constraint_unit, table=table, episodes=EPISODES)
    title = " / ".join(str(results.content[name]) for name in ("game", "operator", "activation"))
    draw_typical(kept["episodes"], folder / "rollout.png", title)
    return found, table


def assess(evaluation: Evaluation, labels: Sequence[Extremal], results: Results) -> Assessed:
    """Play from the starts of the labels."""
    began = time.perf_counter()
    disturbance = evaluation.condition.disturbance
    played = play(evaluation.game, evaluation.policy, labels, evaluation.dt, disturbance)
    found = evaluation._replace(labels=labels, played=played)
    table = CollisionTable().compute(found)
    results.time("evaluation", time.perf_counter() - began)
    return found, table


def check_evaluation(game: Game, settings: DictConfig) -> None:
    """Raise ValueError for entries that make no evaluation of the game."""
    for name, least in (("starts", 1), ("seed", 0)):
        whole_number(name, settings[name], least)
    if settings.get("workers") is not None:
        whole_number("workers", settings.workers, 1)
    for name in ("clearance", "dt"):
        finite_number(name, settings[name])
    table_condition(game, plain(settings))
    flag("safe", settings.safe)
    control_steps(game, settings.dt)
