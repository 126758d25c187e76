"""`python train.py`: labels, training, closed-loop evaluation, results."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning as L

from hno.cli import launch, pages
from hno.cli.arguments import Arguments
from hno.cli.build import build, check, chosen_callbacks, how_to_train, record_of
from hno.cli.config import configured
from hno.cli.evaluate import Types, describe, play_starts, unseen_types
from hno.cli.film import Film
from hno.cli.landscapes import write_landscape
from hno.cli.logs import loggers, rates, use_threads
from hno.cli.media import publish
from hno.cli.perform import Task
from hno.cli.progress import StepLines, label_progress, progress
from hno.cli.results import Results
from hno.cli.resume import finished, history, in_its_folder, run_folder, take_over, training_hash
from hno.cli.sections import run_sections, show
from hno.cli.settings import TrainSettings
from hno.data.certificates import safe_sets, summaries
from hno.data.datamodule import GameData
from hno.data.labels import Request, default_cache, safe_labels_for
from hno.evaluation.sections import Evaluation
from hno.games.grid import parse_types
from hno.training.checkpoint import LearnedPolicy, load_policy
from hno.training.divergence import DivergedError
from hno.training.fit import Fitted, fit
from hno.training.saving import BEST
from hno.training.validation import PROBE, Later
from hno.types import Extremal

log = logging.getLogger(__name__)


def run(given: Arguments) -> int:
    """`hno train`; of a run that is finished and resumed with nothing new, its results."""
    task, there = Task("train", check, head, train), in_its_folder(given)
    if there is not given and "--dry-run" not in given.flags:
        settings = configured("train", check, there)
        if settings is not None and (results := finished(settings)):
            folder = run_folder(str(settings.resume))
            print(f"The run in {folder} is finished, and nothing is new. trainer.max_steps=<more> trains it on.")
            show(results, folder)
            print(pages.write(folder))
            return 0
    return launch.run(task, there)


def head(settings: TrainSettings) -> dict[str, Any]:
    """What results.json says from the beginning."""
    kept = history(settings) if settings.resume is not None else {}
    return {
        "game": settings.game.name,
        "operator": settings.operator.name,
        "function": settings.function["name"],
        "activation": settings.activation["name"],
        "seed": settings.seed,
        "steps": settings.trainer.max_steps,
        "training_hash": training_hash(settings),
        "config": settings.model_dump(exclude={"resume"}),
        **kept,
    }


def train(settings: TrainSettings, results: Results, further: Sequence[L.Callback] = ()) -> None:
    """One run; its folder gets best.ckpt, last.ckpt, metrics and results.json. Further callbacks may watch it."""
    folder = results.path.parent
    fitted = train_operator(settings, folder, results, further)
    policy = load_policy(fitted.checkpoint)
    types = [*policy.types, *unseen_types(policy.game, settings.evaluation.types, "evaluation.types")]
    played, _ = play_starts(described(policy, types, settings, results), results)
    for name, content in run_sections(played, results):
        results.update(**{name: content})
    results.update(**write_landscape(played, results))
    publish(fitted.trainer.loggers, results.content, folder, fitted.trainer.global_step)


def described(policy: LearnedPolicy, types: Sequence[Types], settings: TrainSettings, results: Results) -> Evaluation:
    """The evaluation of what was trained, before anything is solved."""
    models, options = [(str(results.content["checkpoint"]), policy)], settings.evaluation.model_dump()
    (found,) = describe(models, types, options, settings.data.cache, settings.data.workers)
    return found


def landscape_of(policy: LearnedPolicy, settings: TrainSettings, results: Results) -> dict[str, str]:
    """Write the landscape of what was trained without an evaluation, see `write_landscape`."""
    return write_landscape(described(policy, policy.types, settings, results), results)


def train_operator(
    settings: TrainSettings, folder: Path, results: Results, further: Sequence[L.Callback] = ()
) -> Fitted:
    """Solve labels and train; the folder gets `last.ckpt` and `best.ckpt`, the results how it went and which to use."""
    L.seed_everything(settings.seed, verbose=False)
    use_threads(settings.trainer.threads)
    resume, (*_, now) = take_over(settings.resume, folder), results.content.get("resumed", [{"step": 0}])
    makers = loggers(settings, folder, now["step"])
    with label_progress() as report:
        built = build(settings, report)
        _, operator, objective, data = built
        data.setup("fit")
    results.time("labels", data.label_seconds)
    results.update(label_statistics=summaries(data.extremals))
    first, later = validation_starts(settings, data, results)
    try:
        with progress("training", None) as update:
            chosen = chosen_callbacks(settings)
            watching = [StepLines(settings.trainer.print_every, update), *rates(makers, chosen)]
            watching += [Film(folder)] if settings.evaluation.landscape else []
            watching += further
            fitted = fit(
                operator, objective, data, how_to_train(settings), folder, validation=first, later=later,
                record=record_of(settings, built), loggers=makers, callbacks=chosen, watching=watching, resume=resume,
            )  # fmt: skip
    except DivergedError:
        if (folder / BEST).exists():
            results.update(checkpoint=BEST)
        raise
    results.content["seconds"] |= {part: round(seconds, 3) for part, seconds in fitted.seconds.items()}
    if fitted.rounds:
        results.update(rounds=[found._asdict() for found in fitted.rounds])
    results.update(
        steps=fitted.trainer.global_step,
        checkpoint=fitted.checkpoint.name,
        metrics=fitted.metrics,
        validation=None if fitted.best is None else fitted.best._asdict(),
    )
    return fitted


def validation_starts(settings: TrainSettings, data: GameData, results: Results) -> tuple[list[Extremal], Later | None]:
    """Safe starts that closed-loop validation plays: held-out ones, or those of the chosen types.

    Of the latter only those that are played first are solved before the training, the others when they are needed.
    """
    choice, clearance = settings.validation, settings.validation.clearance
    if choice.types is None:
        return safe_sets(data.held_out(), clearance), None
    types = parse_types(data.game, choice.types, key="validation.types")
    cache, workers = Path(settings.data.cache or default_cache()), settings.data.workers

    def solve(starts: int) -> list[Extremal]:
        requests = [Request(theta, starts, choice.seed, "validation") for theta in types]
        log.info("labels of %d safe validation starts at each of %d types", starts, len(types))
        with label_progress("validation labels") as report:
            found, seconds = safe_labels_for(data.game, requests, cache, workers, report, clearance=clearance)
        results.time("validation_labels", seconds)
        return safe_sets(found, clearance)

    first = solve(min(choice.starts, PROBE))
    later = Later(choice.starts * len(types), lambda: solve(choice.starts))
    return first, None if choice.starts <= PROBE else later
