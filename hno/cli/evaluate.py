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
from torch import Tensor

from hno.cli import launch
from hno.cli.arguments import Arguments
from hno.cli.config import read
from hno.cli.landscapes import write_landscape
from hno.cli.logs import loggers, use_threads
from hno.cli.media import draw_typical, publish
from hno.cli.perform import Task
from hno.cli.progress import label_progress, progress
from hno.cli.results import Results, write_json
from hno.cli.sections import chosen_sections, run_sections
from hno.cli.settings import Episodes, EvaluateSettings
from hno.control.exported import ExportedPolicy, is_exported, load_exported
from hno.control.rollout import control_steps
from hno.data.labels import Request, default_cache, labels_for, safe_labels_for
from hno.data.states import equilibria_from
from hno.evaluation.closed_loop import CollisionTable, play
from hno.evaluation.comparison import PairedComparison, check_same_game
from hno.evaluation.conditions import TIES, Condition, table_condition
from hno.evaluation.episodes import EPISODES, PATHS, Kept, episodes, together, write_paths
from hno.evaluation.format import title
from hno.evaluation.outcome import Played, numbers_of
from hno.evaluation.sections import Evaluation
from hno.evaluation.starts import OUTCOMES, starts_of
from hno.games import Game
from hno.games.grid import parse_types, quarter_types
from hno.runtime import ArtefactError
from hno.training.checkpoint import LearnedPolicy, find_checkpoint, load_policy
from hno.types import Extremal

log = logging.getLogger(__name__)

Model = LearnedPolicy | ExportedPolicy
Types = tuple[float, ...]
"""One type per player."""


def run(given: Arguments) -> int:
    """`hno evaluate`."""
    return launch.run(Task("evaluate", check, head, evaluate, models_of), given)


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
    return {"checkpoint": str(models_of(settings)[0]), "config": settings.model_dump()}


def models_of(settings: EvaluateSettings) -> list[Path]:
    """The models of an evaluation, see `model_file`."""
    return [Path(model_file(path)) for path in settings.checkpoint]


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
        with label_progress("test labels") as report:
            return solver(game, requests, place, workers=workers, report=report)[0]

    def equilibria(game: Game, x0: Tensor, theta: Tensor, tau: float) -> Extremal:
        with label_progress("equilibria") as report:
            return equilibria_from(game, x0, theta, tau, place, workers=workers, report=report)

    def starts(condition: Condition) -> Sequence[Extremal]:
        return solve(*condition.starts)

    return [
        Evaluation(name, policy, policy.types, types, options, starts, equilibria=equilibria) for name, policy in models
    ]


def evaluate(settings: EvaluateSettings, results: Results) -> None:
    """Evaluate models; every part is written into the results as it is done."""
    use_threads(settings.threads)
    makers = loggers(settings, results.path.parent)
    policies, evaluations = prepared(settings)
    models: list[dict[str, Any]] = [
        {"checkpoint": evaluation.name, **policy.names(), "seed": policy.origin()["seed"]}
        for policy, evaluation in zip(policies, evaluations, strict=True)
    ]
    results.update(**models[0])
    played, shared = list[Evaluation](), dict[Types, list[int]]()
    for number, (model, evaluation) in enumerate(zip(models, evaluations, strict=True)):
        log.info("evaluation of %s", evaluation.name)
        found, files = play_starts(evaluation, results, number, shared)
        model.update(files)
        played.append(found)
        for name, content in run_sections(found, results):
            model[name] = content
            results.update(**models[0])
        model |= write_landscape(found, results, number)
        results.update(**models[0])
    if len(models) > 1:
        results.update(models=models, comparison=PairedComparison().compute(played))
    if makers:
        publish(makers, results.content, results.path.parent, 0)


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


def play_starts(
    evaluation: Evaluation, results: Results, number: int = 0, shared: dict[Types, list[int]] | None = None
) -> tuple[Evaluation, dict[str, Any]]:
    """Play from the test starts, whose labels are in the cache or solved now.

    Some episodes are kept beside the results, and what came of every start; the first model's table is in the results.

    Args:
        evaluation: the model.
        results: of the run.
        number: of the model, which is in the names of its files.
        shared: starts, by type, whose episodes all models keep; the first one adds those that it has.

    Returns:
        The evaluation with its labels and episodes, and the model's entries of the results: its table and files.
    """
    began, game, shared = time.perf_counter(), evaluation.game, {} if shared is None else shared
    labels, disturbance = evaluation.solve(evaluation.condition), evaluation.condition.disturbance
    solved, played, kept = time.perf_counter(), list[Played](), list[Kept]()
    with progress("evaluation") as update:
        update(0, len(labels))
        for label, paths in play(game, evaluation.policy, labels, evaluation.dt, disturbance):
            theta = tuple(label.theta[0].tolist())
            played.append(numbers_of(game, label, paths))
            own = episodes(evaluation, label, paths, shared.get(theta, ()))
            shared.setdefault(theta, [one.row for one in own])
            kept += own
            update(len(played), len(labels))
    found = evaluation._replace(labels=labels, played=played)
    entries = {"table": CollisionTable().compute(found), **_write(found, kept, results.path.parent, number)}
    results.time("test_labels", solved - began)
    results.time("evaluation", time.perf_counter() - solved)
    if results.content["episodes"] is None:
        conditions = {name: found.options[name] for name in ("clearance", "dt", "widen", "noise", "delay")}
        conditions["learns"] = found.options.get("learns")  # what no run has while it trains
        results.update(**conditions, test_seed=disturbance.seed, constraint_unit=game.constraint_unit, **entries)
        draw_typical([one.content for one in kept], results.path.parent / "rollout.png", title(results.content))
    return found, entries


def _write(found: Evaluation, kept: Sequence[Kept], folder: Path, number: int) -> dict[str, str]:
    """Write what is kept of a model's episodes; returns the names of the files."""
    names = {"episodes": EPISODES, "paths": PATHS, "outcomes": OUTCOMES}
    files = {key: name.replace(".", f"_{number}.", 1) if number else name for key, name in names.items()}
    write_json(folder / files["outcomes"], {"types": starts_of(found)})
    write_json(folder / files["episodes"], together(found.game, kept))
    write_paths(kept, folder / files["paths"])
    return files


def check_evaluation(game: Game, settings: Episodes) -> None:
    """Raise ValueError for entries that make no evaluation of the game."""
    table_condition(game, settings.model_dump())
    control_steps(game, settings.dt)
    if settings.landscape_truth == 1:
        raise ValueError("landscape_truth is the points along each side of a plane: 0 for none, or at least 2; got 1.")
