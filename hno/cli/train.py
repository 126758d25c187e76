"""`python train.py`: labels, training, closed-loop evaluation, results."""

from __future__ import annotations

import logging
import shutil
import sys
from pathlib import Path
from typing import Any

import lightning as L

from hno.cli import launch
from hno.cli.arguments import Arguments
from hno.cli.build import build, check, how_to_train
from hno.cli.evaluate import describe, play_starts, unseen_types
from hno.cli.logs import StepBar, StepLines, label_progress, loggers, use_threads
from hno.cli.media import publish
from hno.cli.results import Results, config_hash
from hno.cli.sections import run_sections
from hno.cli.settings import TrainSettings
from hno.data.certificates import safe_sets, summaries
from hno.data.datamodule import GameData
from hno.data.labels import Request, default_cache, safe_labels_for
from hno.games.grid import parse_types
from hno.training.checkpoint import Provenance, check_resumable, find_checkpoint, load_policy, record, same_run
from hno.training.divergence import DivergedError
from hno.training.fit import Fitted, fit
from hno.training.saving import BEST, RESUMED
from hno.training.validation import PROBE, Later
from hno.types import Extremal

log = logging.getLogger(__name__)


def run(given: Arguments) -> int:
    """`hno train`."""
    return launch.run(launch.Task("train", check, head, train), given)


def head(settings: TrainSettings) -> dict[str, Any]:
    """What results.json says from the beginning."""
    return {
        "game": settings.game.name,
        "operator": settings.operator.name,
        "function": settings.function["name"],
        "activation": settings.activation["name"],
        "seed": settings.seed,
        "steps": settings.trainer.max_steps,
        "config_hash": config_hash(settings),
        "config": settings.model_dump(),
    }


def train(settings: TrainSettings, results: Results) -> None:
    """One run; its folder gets best.ckpt, last.ckpt, metrics and results.json."""
    folder = results.path.parent
    fitted = train_operator(settings, folder, results)
    policy, chosen = load_policy(fitted.checkpoint), settings.evaluation
    types = [*policy.types, *unseen_types(policy.game, chosen.types, "evaluation.types")]
    models = [(str(results.content["checkpoint"]), policy)]
    (evaluation,) = describe(models, types, chosen.model_dump(), settings.data.cache, settings.data.workers)
    played, _ = play_starts(evaluation, results)
    for name, content in run_sections(played, results):
        results.update(**{name: content})
    publish(fitted.trainer.loggers, results.content, folder, fitted.trainer.global_step)


def train_operator(settings: TrainSettings, folder: Path, results: Results) -> Fitted:
    """Solve labels and train; the folder gets `last.ckpt` and `best.ckpt`, the results how it went and which to use."""
    L.seed_everything(settings.seed, verbose=False)
    use_threads(settings.trainer.threads)
    architecture, operator, objective, data = build(settings, label_progress())
    origin = Provenance(settings.operator.name, data.type_list, settings.seed, config_hash(settings))
    entries, makers = record(data.game, architecture, origin), loggers(settings, folder)
    resume = None if settings.resume is None else find_checkpoint(settings.resume, RESUMED)
    if resume is not None:
        check_resumable(resume, entries, settings.trainer.max_steps)
    _take_over(resume, folder / BEST)

    data.setup("fit")
    results.time("labels", data.label_seconds)
    results.update(label_statistics=summaries(data.extremals))
    first, later = validation_starts(settings, data, results)
    before = results.content["seconds"].get("validation_labels", 0.0)
    bar = StepBar() if sys.stdout.isatty() else StepLines(settings.trainer.print_every)
    try:
        fitted = fit(
            operator, objective, data, how_to_train(settings), folder, validation=first, later=later, record=entries,
            loggers=makers, callbacks=[bar], resume=resume,
        )  # fmt: skip
    except DivergedError:
        if (folder / BEST).exists():
            results.update(checkpoint=BEST)
        raise
    solving = results.content["seconds"].get("validation_labels", 0.0) - before  # while validation played
    results.time("training", fitted.seconds["training"])
    results.time("validation", fitted.seconds["validation"] - solving)
    if fitted.rounds:
        results.time("added_labels", fitted.seconds["added_labels"])
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
    choice, clearance = settings.validation, settings.evaluation.clearance
    if choice.types is None:
        return safe_sets(data.held_out(), clearance), None
    types = parse_types(data.game, choice.types, key="validation.types")
    cache, workers = Path(settings.data.cache or default_cache()), settings.data.workers

    def solve(starts: int) -> list[Extremal]:
        requests = [Request(theta, starts, choice.seed, "validation") for theta in types]
        log.info("labels of %d safe validation starts at each of %d types", starts, len(types))
        found, seconds = safe_labels_for(data.game, requests, cache, workers, label_progress(), clearance=clearance)
        results.time("validation_labels", seconds)
        return safe_sets(found, clearance)

    first = solve(min(choice.starts, PROBE))
    later = Later(choice.starts * len(types), lambda: solve(choice.starts))
    return first, None if choice.starts <= PROBE else later


def _take_over(resume: Path | None, to: Path) -> None:
    """Go on from the best checkpoint of the run that is resumed; one of another run in our folder goes."""
    if resume is None or not same_run(best := resume.with_name(BEST), resume):
        to.unlink(missing_ok=True)
    elif best.resolve() != to.resolve():
        shutil.copy2(best, to)
