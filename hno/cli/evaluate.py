"""`python evaluate.py checkpoint=<path>`: how safe trained models are, and where they err."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from hno.cli import launch
from hno.cli.arguments import Arguments
from hno.cli.checkpoints import trained
from hno.cli.config import read
from hno.cli.logs import send_lightning_to_hydra, use_threads
from hno.cli.media import draw_typical
from hno.cli.results import Results, config_hash, plain, write_json
from hno.cli.schema import Episodes, EvaluateSettings
from hno.cli.sections import chosen_sections, run_sections
from hno.cli.starts import cache_folder, label_solver
from hno.cli.summary import report, show
from hno.control.rollout import control_steps
from hno.evaluation.closed_loop import CollisionTable, play
from hno.evaluation.comparison import PairedComparison, check_same_game
from hno.evaluation.conditions import table_condition
from hno.evaluation.episodes import EPISODES, episodes
from hno.evaluation.sections import Evaluation
from hno.games import Game
from hno.games.grid import parse_types
from hno.training.checkpoint import LearnedPolicy, load_policy
from hno.types import Extremal

log = logging.getLogger(__name__)

Types = tuple[float, ...]
"""One type per player."""


def run(given: Arguments) -> int:
    """`hno evaluate`."""
    return launch.run("evaluate", check, evaluate, given)


def check(config: DictConfig) -> EvaluateSettings:
    """The settings of an evaluation that can be made; nothing is solved or written.

    Raises:
        ValueError, LookupError: entries that are unknown or make no sense, together or for the game.
        CheckpointError: a checkpoint that cannot be read.
    """
    settings = read(EvaluateSettings, config)
    with warnings.catch_warnings(action="ignore"):  # the run warns
        policies, types = load(settings)
        for evaluation in describe(settings, list(map(str, checkpoints_of(settings))), policies, types):
            for section in chosen_sections(evaluation.options).values():
                section.check(evaluation)
    return settings


def describe(
    settings: EvaluateSettings, names: Sequence[str], policies: Sequence[LearnedPolicy], types: Sequence[Types]
) -> list[Evaluation]:
    """The evaluation of every model, before its labels are solved."""
    options = plain(settings)
    solve = label_solver(policies[0].game, types, options, cache_folder(settings.cache), settings.workers)
    pairs = zip(names, policies, strict=True)
    return [Evaluation(name, policy, policy.types, types, options, solve) for name, policy in pairs]


def load(settings: EvaluateSettings) -> tuple[list[LearnedPolicy], list[tuple[float, ...]]]:
    """The models to evaluate and the types at which to do so. Raises as `check`."""
    paths = checkpoints_of(settings)
    policies = [load_policy(path, settings.expected_game) for path in paths]
    check_same_game(list(map(str, paths)), [policy.game for policy in policies])
    check_evaluation(policies[0].game, settings)
    chosen = [types_to_evaluate(settings.theta, policy, settings.unseen) for policy in policies]
    return policies, list(dict.fromkeys(theta for own in chosen for theta in own))


def evaluate(settings: EvaluateSettings) -> bool:
    """Evaluate checkpoints and write results.json into the run's own folder.

    Returns:
        Whether it succeeded. A failure has been logged and is in results.json.
    """
    send_lightning_to_hydra()
    folder, paths = Path(HydraConfig.get().runtime.output_dir), list(map(str, checkpoints_of(settings)))
    head = {"checkpoint": paths[0], "config_hash": config_hash(settings), "config": plain(settings)}
    results = Results(folder / "results.json", head)
    try:
        evaluate_models(settings, paths, results)
    except Exception as error:
        results.update(status="failed", reason=f"{type(error).__name__}: {error}")
        report(error)
        return False
    except (KeyboardInterrupt, SystemExit):  # Lightning turns the one into the other
        results.update(status="failed", reason="interrupted")
        raise
    show(results.content, folder)
    return True


def checkpoints_of(settings: EvaluateSettings) -> list[Path]:
    """Files of the models: one, or several of a list."""
    given = settings.checkpoint
    return [trained(str(path)) for path in (given if isinstance(given, list) else [given])]


def evaluate_models(settings: EvaluateSettings, paths: Sequence[str], results: Results) -> None:
    """Evaluate the models of these files; every part is written into the results as it is done."""
    use_threads(settings.threads)
    policies, types = load(settings)
    results.update(**policies[0].names(), seed=policies[0].provenance.seed)
    evaluations = describe(settings, paths, policies, types)
    labels = solve_tests(evaluations[0], results)
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


def types_to_evaluate(choice: Any, policy: LearnedPolicy, unseen: Any = None) -> list[tuple[float, ...]]:
    """Player types to evaluate a policy at.

    Default are the labelled types and those that `unseen` adds.

    Args:
        choice: "default", or what `parse_types` takes.
        policy: the policy.
        unseen: see `unseen_types`.

    Raises:
        ValueError: none of these, or entries that are not one finite number per player.
    """
    if choice != "default":
        return parse_types(policy.game, choice, key="theta", also=("default",))
    return list(dict.fromkeys([*policy.types, *unseen_types(policy.game, unseen, "unseen")]))


def unseen_types(game: Game, choice: Any, key: str) -> list[tuple[float, ...]]:
    """Types that are evaluated beside the labelled ones: the chosen ones, or four at quarters of the type box.

    Args:
        game: the game.
        choice: what `parse_types` takes; None for the four.
        key: where the choice stands, for messages.
    """
    if choice is not None:
        return parse_types(game, choice, key=key) if choice else []
    lo, width = game.type_box.lo, game.type_box.hi - game.type_box.lo
    quarters = [[own, *[others] * (game.players - 1)] for own, others in QUARTERS]
    return game.validate_types([(lo + width * torch.tensor(row) / 4).tolist() for row in quarters])


QUARTERS = ((0, 1), (1, 1), (1, 3), (3, 4))
"""Places in the type box, of the first player and of the others, in quarters of its edges."""


def solve_tests(evaluation: Evaluation, results: Results) -> list[Extremal]:
    """Labels of the test starts of every type, from the cache or solved."""
    began = time.perf_counter()
    labels = list(evaluation.solve(evaluation.condition))
    results.time("test_labels", time.perf_counter() - began)
    results.update(test_seed=evaluation.condition.disturbance.seed)
    return labels


Assessed = tuple[Evaluation, list[dict[str, Any]]]
"""An evaluation with its episodes, and the rows of its table."""


def evaluate_policy(evaluation: Evaluation, labels: Sequence[Extremal], results: Results) -> Assessed:
    """Play from the starts of the labels, put the table into the results, keep some episodes and draw one."""
    found, table = assess(evaluation, labels, results)
    folder, game = results.path.parent, found.game
    kept = episodes(found)
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


def check_evaluation(game: Game, settings: Episodes) -> None:
    """Raise ValueError for entries that make no evaluation of the game."""
    table_condition(game, plain(settings))
    control_steps(game, settings.dt)
