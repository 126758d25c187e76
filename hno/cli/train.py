"""`python train.py`: labels, training, closed-loop evaluation, results."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from hno.cli.build import (
    build_architecture,
    build_data,
    build_game,
    build_objective,
    build_settings,
    cache_folder,
    check_numbers,
)  # fmt: skip
from hno.cli.checks import whole_number
from hno.cli.config import run_command
from hno.cli.evaluate import check_evaluation, evaluate_policy, solve_tests
from hno.cli.logs import StepLines, finish_wandb, label_progress, loggers, progress_bar, send_lightning_to_hydra
from hno.cli.media import publish
from hno.cli.ntk import check_rows, ntk_section
from hno.cli.results import Results, config_hash, plain
from hno.cli.summary import report, show
from hno.data import GameData
from hno.data.labels import Request, safe_labels_for
from hno.data.trust import safe, summary
from hno.games import Game
from hno.games.grid import parse_types
from hno.operators import make_operator
from hno.training.checkpoint import Provenance, check_resumable, load_policy, record
from hno.training.divergence import DivergedError
from hno.training.fit import Fitted, fit
from hno.training.optimizers import make_optimizer
from hno.training.validation import BEST
from hno.types import Extremal, part

log = logging.getLogger(__name__)


def main() -> None:
    """Entry point."""
    run_command("train", train)


def train(config: DictConfig) -> bool:
    """One run; its folder gets best.ckpt, last.ckpt, metrics and results.json.

    Returns:
        Whether it succeeded. A failure has been logged and is in results.json.
    """
    send_lightning_to_hydra()
    folder = Path(HydraConfig.get().runtime.output_dir)
    head = {
        "game": config.game.name,
        "operator": config.operator.name,
        "activation": config.activation.name,
        "seed": config.seed,
        "steps": config.trainer.max_steps,
        "config_hash": config_hash(config),
        "config": plain(config),
    }
    results = Results(folder / "results.json", head)
    try:
        _run(config, folder, results)
    except Exception as error:
        results.update(status="failed", reason=f"{type(error).__name__}: {error}")
        report(error)
        if isinstance(error, DivergedError) and (folder / BEST).exists():
            results.update(checkpoint=BEST)
            log.error("The last good checkpoint is %s.", folder / BEST)
        return False
    except (KeyboardInterrupt, SystemExit):  # Lightning turns the one into the other
        results.update(status="failed", reason="interrupted")
        raise
    finally:
        finish_wandb(results.content)
    show(results.content, folder)
    return True


def _run(config: DictConfig, folder: Path, results: Results) -> None:
    check_numbers(config)
    settings = config.evaluation
    game = build_game(config)
    check_evaluation(game, settings)
    unseen = game.validate_types(settings.types)
    if settings.ntk:
        check_rows(make_operator(game, build_architecture(config)), settings)
    fitted = train_operator(config, folder, results)
    policy = load_policy(fitted.checkpoint)
    types = list(dict.fromkeys([*policy.types, *unseen]))
    test = solve_tests(game, types, settings, cache_folder(config.data.cache), config.data.workers, results)
    evaluate_policy(policy, test, settings, results)
    if settings.ntk:
        began = time.perf_counter()
        results.update(ntk=ntk_section(policy, test, settings))
        results.time("ntk", time.perf_counter() - began)
    results.update(status="finished")
    publish(fitted.trainer.loggers, results.content, folder, fitted.trainer.global_step)


def train_operator(config: DictConfig, folder: Path, results: Results) -> Fitted:
    """Solve labels and train; the folder gets `last.ckpt` and `best.ckpt`, the results how it went and which to use."""
    check_numbers(config)
    L.seed_everything(config.seed, verbose=False)
    if config.trainer.threads is not None:
        torch.set_num_threads(config.trainer.threads)
    game, architecture, objective = build_game(config), build_architecture(config), build_objective(config)
    operator = make_operator(game, architecture)
    terms = objective.used(exact_terminal=operator.meets_terminal)
    data = build_data(config, game, frozenset(term.stream for term in terms.values()), label_progress())
    origin = Provenance(config.operator.name, data.type_list, config.seed, config_hash(config))
    entries, settings = record(game, architecture, origin), build_settings(config)
    check_validation(data.game, config.validation)
    make_optimizer(steps=settings.steps, **settings.optimizer)
    makers = loggers(config, folder)
    resume = None if config.resume is None else Path(config.resume)
    if resume is not None:
        check_resumable(resume, entries)
    _take_over(None if resume is None else resume.parent / BEST, folder / BEST)

    data.setup("fit")
    results.time("labels", data.label_seconds)
    results.update(label_statistics=label_statistics(data.extremals))
    validation = validation_labels(config, data, results)
    fitted = fit(
        operator, objective, data, settings, folder,
        validation=validation, record=entries, loggers=makers, callbacks=[progress(config)], resume=resume,
    )  # fmt: skip
    for name, seconds in fitted.seconds.items():
        results.time(name, seconds)
    results.update(
        steps=fitted.trainer.global_step,
        checkpoint=fitted.checkpoint.name,
        metrics=fitted.metrics,
        validation=None if fitted.best is None else fitted.best._asdict(),
    )
    return fitted


def progress(config: DictConfig) -> L.Callback:
    """A live bar on a terminal, lines elsewhere."""
    return progress_bar() or StepLines(config.trainer.print_every)


def label_statistics(labels: Sequence[Extremal]) -> list[dict[str, Any]]:
    """What the certificates of the training labels say, type by type."""
    return [
        {"theta": theta.tolist(), **summary(part(found, (found.theta == theta).all(-1)))}
        for found in labels
        for theta in found.theta.unique(dim=0)
    ]


def validation_labels(config: DictConfig, data: GameData, results: Results) -> list[Extremal]:
    """Labels of the safe starts that closed-loop validation plays, one set per type that has any."""
    choice, clearance = config.validation, config.evaluation.clearance
    found = data.held_out()
    if choice.types is not None:
        types = parse_types(data.game, choice.types)
        requests = [Request(theta, choice.starts, choice.seed, "validation") for theta in types]
        found, seconds = safe_labels_for(
            data.game,
            requests,
            cache_folder(config.data.cache),
            config.data.workers,
            label_progress(),
            clearance=clearance,
        )
        results.time("validation_labels", seconds)
    selected = [part(labels, safe(labels, clearance)) for labels in found]
    return [labels for labels in selected if len(labels.status)]


def _take_over(best: Path | None, to: Path) -> None:
    """Go on from the best checkpoint of the run that is resumed; one of another run in our folder goes."""
    if best is None or not best.exists():
        to.unlink(missing_ok=True)
    elif best.resolve() != to.resolve():
        shutil.copy2(best, to)


def check_validation(game: Game, choice: DictConfig) -> None:
    """Raise ValueError for entries that make no validation of the game."""
    if choice.types is not None:
        parse_types(game, choice.types)
        whole_number("validation.starts", choice.starts, 1)
