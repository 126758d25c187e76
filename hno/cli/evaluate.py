"""`python evaluate.py checkpoint=<path>`: how safe trained models are, and where they err."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from hno.cli.build import cache_folder
from hno.cli.checks import finite_number, flag, whole_number
from hno.cli.config import run_command
from hno.cli.logs import send_lightning_to_hydra
from hno.cli.results import Results, config_hash, plain, write_json
from hno.cli.sections import check_sections, run_sections
from hno.cli.starts import solve_starts
from hno.cli.summary import report, show
from hno.control.rollout import Disturbance, control_steps, rollout
from hno.evaluation.closed_loop import TypeRow, classify, collided, play, tabulate
from hno.evaluation.comparison import check_same_game, compare
from hno.evaluation.episodes import EPISODES, episodes
from hno.games import Game
from hno.games.grid import parse_types
from hno.report.picture import PlotsMissingError, rollout_picture, typical
from hno.training.checkpoint import LearnedPolicy, load_policy
from hno.types import Extremal, Trajectory

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
    for policy in policies:
        check_sections(policy, types, config)
    labels = solve_tests(game, types, config, cache_folder(config.cache), config.workers, results)
    models, outcomes = list[dict[str, Any]](), list[Sequence[Tensor]]()
    for path, policy in zip(paths, policies, strict=True):
        log.info("evaluation of %s", path)
        found = assess(policy, labels, config, results) if models else evaluate_policy(policy, labels, config, results)
        outcomes.append(found.collided)
        table = [row._asdict() for row in found.table]
        names = {**policy.names(), "seed": policy.provenance.seed}
        models.append({"checkpoint": path, **names, "table": table})
        for name, content in run_sections(policy, labels, config, results):
            models[-1][name] = content
            results.update(**models[0])
    if len(models) > 1:
        results.update(models=models, comparison=comparison(paths, types, outcomes))
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


def solve_tests(
    game: Game,
    types: Sequence[tuple[float, ...]],
    settings: DictConfig,
    cache: Path,
    workers: int | None,
    results: Results,
) -> list[Extremal]:
    """Labels of the test starts of every type, from the cache or solved."""
    labels, seconds = solve_starts(game, types, settings, cache, workers, float(settings.widen))
    results.time("test_labels", seconds)
    results.update(test_seed=settings.seed)
    return labels


class Outcome(NamedTuple):
    """What came of the episodes of a policy."""

    table: list[TypeRow]
    """Type by type."""
    played: list[Trajectory]
    """The episodes of every type."""
    collided: list[Tensor]
    """Whether it collides, start by start, one (safe starts,) per type."""


def evaluate_policy(
    policy: LearnedPolicy, labels: Sequence[Extremal], settings: DictConfig, results: Results
) -> Outcome:
    """Roll out from the starts of the labels, put the table into the results, keep some episodes and draw one."""
    found = assess(policy, labels, settings, results)
    write_json(results.path.parent / EPISODES, episodes(policy.game, found.played, labels, settings.clearance))
    conditions = {name: settings[name] for name in ("clearance", "dt", "widen", "noise", "delay")}
    results.update(**conditions, table=[row._asdict() for row in found.table], episodes=EPISODES)
    draw(policy, labels[0], results.path.parent / "rollout.png", settings.dt)
    return found


def assess(policy: LearnedPolicy, labels: Sequence[Extremal], settings: DictConfig, results: Results) -> Outcome:
    """Roll out from the starts of the labels."""
    began = time.perf_counter()
    disturbance = Disturbance(settings.noise, settings.delay, settings.seed)
    played = play(policy.game, policy, labels, settings.dt, disturbance)
    table = tabulate(policy.game, labels, played, policy.types, settings.clearance, policy.operator.field)
    safe = [classify(found, settings.clearance)[0] for found in labels]
    results.time("evaluation", time.perf_counter() - began)
    return Outcome(table, played, [collided(part)[mask] for part, mask in zip(played, safe, strict=True)])


def comparison(
    paths: Sequence[str], types: Sequence[tuple[float, ...]], outcomes: Sequence[Sequence[Tensor]]
) -> dict[str, Any]:
    """Every model against the first, over all types and type by type."""
    rows = []
    for path, other in zip(paths[1:], outcomes[1:], strict=True):
        pairs = zip(types, outcomes[0], other, strict=True)
        by_type = [{"theta": theta, **compare(first, second)._asdict()} for theta, first, second in pairs]
        whole = compare(torch.cat(list(outcomes[0])), torch.cat(list(other)))
        rows.append({"checkpoint": path, **whole._asdict(), "types": by_type})
    return {"reference": paths[0], "models": rows}


def draw(policy: LearnedPolicy, found: Extremal, path: Path, dt: float, episodes: int = 15) -> None:
    """Draw a typical episode from the first starts of a label set; without matplotlib, say so."""
    starts, theta = found.x[:episodes, 0].float(), found.theta[:episodes].float()
    played = rollout(policy.game, policy, starts, theta, dt)
    names = policy.names()
    try:
        rollout_picture(policy.game, played, theta, path, " / ".join(names.values()), typical(played))
    except PlotsMissingError as error:
        log.info("No picture: %s", error)


def check_evaluation(game: Game, settings: DictConfig) -> None:
    """Raise ValueError for entries that make no evaluation of the game."""
    for name, least in (("starts", 1), ("seed", 0), ("delay", 0)):
        whole_number(name, settings[name], least)
    if settings.get("workers") is not None:
        whole_number("workers", settings.workers, 1)
    for name in ("clearance", "dt", "noise", "widen"):
        finite_number(name, settings[name])
    if settings.widen == 0:
        raise ValueError("widen must be a positive number; got 0.")
    flag("safe", settings.safe)
    control_steps(game, settings.dt)
