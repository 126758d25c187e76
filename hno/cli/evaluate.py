"""`python evaluate.py checkpoint=<path>`: how safe trained models are, and where they err."""

from __future__ import annotations

import functools
import logging
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hno.cli import launch
from hno.cli.arguments import Arguments
from hno.cli.config import read
from hno.cli.landscapes import write_landscape
from hno.cli.logs import label_progress, use_threads
from hno.cli.media import draw_typical
from hno.cli.results import Results, write_json
from hno.cli.sections import chosen_sections, run_sections
from hno.cli.settings import Episodes, EvaluateSettings
from hno.control.exported import ExportedPolicy, is_exported, load_exported
from hno.control.rollout import control_steps
from hno.data.labels import Request, default_cache, labels_for, safe_labels_for
from hno.data.states import equilibria_from
from hno.evaluation.closed_loop import CollisionTable, play
from hno.evaluation.comparison import PairedComparison, check_same_game
from hno.evaluation.conditions import TIES, table_condition
from hno.evaluation.episodes import EPISODES, episodes, together
from hno.evaluation.format import title
from hno.evaluation.outcome import Played, numbers_of
from hno.evaluation.sections import Evaluation
from hno.games import Game
from hno.games.grid import parse_types, quarter_types
from hno.runtime import ArtefactError
from hno.training.checkpoint import LearnedPolicy, find_checkpoint, load_policy
from hno.types import Extremal

log = logging.getLogger(__name__)

Model = LearnedPolicy | ExportedPolicy
Types = tuple[float, ...]
"""One type per player."""
Table = list[dict[str, Any]]


def run(given: Arguments) -> int:
    """`hno evaluate`."""
    return launch.run(launch.Task("evaluate", check, head, evaluate), given)


def check(config: DictConfig) -> EvaluateSettings:
    """The settings of an evaluation that can be made; nothing is solved or written.

    Raises:
        ValueError, LookupError: entries that are unknown or make no sense, together or for the game.
        CheckpointError: a checkpoint that cannot be read.
    """
    settings = read(EvaluateSettings, config)
    with warnings.catch_warnings(action="ignore"):  # the run warns
        for evaluation in prepared(settings)[1]:
            for section in chosen_sections(evaluation.options).values():
                section.check(evaluation)
    return settings


def head(settings: EvaluateSettings) -> dict[str, Any]:
    """What results.json says from the beginning."""
    first = model_file(settings.checkpoint[0])
    return {"checkpoint": first, "config": settings.model_dump()}


def model_file(path: str) -> str:
    """The checkpoint that a path stands for, or the folder of an exported controller."""
    return path if is_exported(path) else str(find_checkpoint(path))


def model(path: str, game: str | None) -> Model:
    """The policy of a checkpoint, or of an exported controller; where a game is named, of that one."""
    if not is_exported(path):
        return load_policy(path, game)
    found = load_exported(path)
    if game not in (None, found.names()["game"]):
        raise ArtefactError(f"{path} is a controller of game {found.names()['game']!r}, expected {game!r}.")
    return found


def prepared(settings: EvaluateSettings) -> tuple[list[Model], list[Evaluation]]:
    """The models and their evaluations, before labels are solved. Raises as `check`."""
    paths = [model_file(path) for path in settings.checkpoint]
    policies = [model(path, settings.expected_game) for path in paths]
    check_same_game(paths, [policy.game for policy in policies])
    check_evaluation(policies[0].game, settings)
    types = [theta for one in policies for theta in types_to_evaluate(settings.theta, one, settings.unseen)]
    models = list(zip(paths, policies, strict=True))
    return policies, describe(models, types, settings.model_dump(), settings.cache, settings.workers)


def describe(
    models: Sequence[tuple[str, Model]],
    types: Sequence[Types],
    options: Mapping[str, Any],
    cache: str | None,
    workers: int | None,
) -> list[Evaluation]:
    """The evaluation of models of one game, by the path of each checkpoint.

    Labels of the starts depend on the game, the types and the options `starts`, `seed`, `safe` and `clearance` alone:
    every model meets the same ones. Equal starts have the same labels, the same object.
    """
    game, types, place = models[0][1].game, list(dict.fromkeys(types)), Path(cache or default_cache())
    solver = functools.partial(safe_labels_for, clearance=options["clearance"]) if options["safe"] else labels_for

    @functools.cache
    def solve(widen: float, symmetric: bool, ties: bool) -> Sequence[Extremal]:
        starts = min(options["starts"], TIES) if ties else options["starts"]
        kind = starts, options["seed"], "test", widen, symmetric, ties
        requests = [Request(theta, *kind) for theta in types]
        return solver(game, requests, place, workers=workers, report=label_progress())[0]

    equilibria = functools.partial(equilibria_from, cache=place, workers=workers, report=label_progress())
    return [
        Evaluation(
            name,
            policy,
            policy.types,
            types,
            options,
            lambda condition: solve(*condition.starts),
            equilibria=equilibria,
        )
        for name, policy in models
    ]


def evaluate(settings: EvaluateSettings, results: Results) -> None:
    """Evaluate models; every part is written into the results as it is done."""
    use_threads(settings.threads)
    policies, evaluations = prepared(settings)
    models: list[dict[str, Any]] = [
        {"checkpoint": evaluation.name, **policy.names(), "seed": policy.origin()["seed"]}
        for policy, evaluation in zip(policies, evaluations, strict=True)
    ]
    results.update(**models[0])
    played = list[Evaluation]()
    for number, (model, evaluation) in enumerate(zip(models, evaluations, strict=True)):
        log.info("evaluation of %s", evaluation.name)
        found, model["table"] = play_starts(evaluation, results)
        played.append(found)
        for name, content in run_sections(found, results):
            model[name] = content
            results.update(**models[0])
        model |= write_landscape(found, results, number)
        results.update(**models[0])
    if len(models) > 1:
        results.update(models=models, comparison=PairedComparison().compute(played))


def types_to_evaluate(choice: Any, policy: Model, unseen: Any = None) -> list[Types]:
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


def unseen_types(game: Game, choice: Any, key: str) -> list[Types]:
    """Types that are evaluated beside the labelled ones: the chosen ones, or four at quarters of the type box.

    Args:
        game: the game.
        choice: what `parse_types` takes; None for the four.
        key: where the choice stands, for messages.
    """
    if choice is None:
        return quarter_types(game)
    return [] if choice == [] else parse_types(game, choice, key=key)


def play_starts(evaluation: Evaluation, results: Results) -> tuple[Evaluation, Table]:
    """Play from the test starts, whose labels are in the cache or solved now.

    The first model's table goes into the results, and some of its episodes are kept.

    Returns:
        The evaluation with its labels and episodes, and the rows of its table.
    """
    began, game, folder = time.perf_counter(), evaluation.game, results.path.parent
    labels, disturbance = evaluation.solve(evaluation.condition), evaluation.condition.disturbance
    solved, played, kept = time.perf_counter(), list[Played](), list[dict[str, Any]]()
    for label, paths in play(game, evaluation.policy, labels, evaluation.dt, disturbance):
        played.append(numbers_of(game, label, paths))
        kept += episodes(evaluation, label, paths)
    found = evaluation._replace(labels=labels, played=played)
    table = CollisionTable().compute(found)
    results.time("test_labels", solved - began)
    results.time("evaluation", time.perf_counter() - solved)
    if results.content["episodes"] is None:
        write_json(folder / EPISODES, together(game, kept))
        conditions = {name: found.options[name] for name in ("clearance", "dt", "widen", "noise", "delay")}
        conditions["learns"] = found.options.get("learns")  # what no run has while it trains
        results.update(**conditions, test_seed=disturbance.seed, constraint_unit=game.constraint_unit)
        results.update(table=table, episodes=EPISODES)
        draw_typical(kept, folder / "rollout.png", title(results.content))
    return found, table


def check_evaluation(game: Game, settings: Episodes) -> None:
    """Raise ValueError for entries that make no evaluation of the game."""
    table_condition(game, settings.model_dump())
    control_steps(game, settings.dt)
    if settings.landscape_truth == 1:
        raise ValueError("landscape_truth is the points along each side of a plane: 0 for none, or at least 2; got 1.")
