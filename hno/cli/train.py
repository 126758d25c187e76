"""`python train.py`: labels, training, closed-loop evaluation, results."""

from __future__ import annotations

import logging
import math
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from hno.cli.build import build_data, build_game, build_operator, build_trainer, cache_folder, check_numbers
from hno.cli.checks import whole_number
from hno.cli.config import run_command
from hno.cli.evaluate import check_evaluation, evaluate_policy, solve_tests
from hno.cli.logs import finish_wandb, label_progress, send_lightning_to_hydra
from hno.cli.media import publish
from hno.cli.results import Results, config_hash, plain
from hno.cli.sections import evaluation_of, run_sections
from hno.cli.starts import TestLabels
from hno.cli.summary import report, show
from hno.data import GameData
from hno.data.certificates import safe, summary
from hno.data.labels import Request, safe_labels_for
from hno.evaluation.ntk import check_rows
from hno.games import Game
from hno.games.grid import parse_types
from hno.losses import Scales
from hno.training.checkpoint import check_resumable, load_policy
from hno.training.divergence import DivergedError
from hno.training.polish import polish
from hno.training.validation import BEST, ClosedLoopValidation
from hno.types import Extremal, part

log = logging.getLogger(__name__)

LONG = 20_000
"""Steps from which on compiling pays: it takes some ten seconds and saves about a millisecond a step."""


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
        check_rows(build_operator(config, game), settings.ntk_rows)
    trainer = fit(config, folder, results)
    policy = load_policy(folder / results.content["checkpoint"])
    types = list(dict.fromkeys([*policy.operator.seen_types, *unseen]))
    solve = TestLabels(game, types, settings, cache_folder(config.data.cache), config.data.workers)
    evaluation = evaluation_of(results.content["checkpoint"], policy, types, settings, solve)
    played, _ = evaluate_policy(evaluation, solve_tests(solve, evaluation, results), results)
    for name, content in run_sections(played, results):
        results.update(**{name: content})
    results.update(status="finished")
    publish(trainer.loggers, results.content, folder, trainer.global_step)


def fit(config: DictConfig, folder: Path, results: Results) -> L.Trainer:
    """Solve labels and train; the folder gets `last.ckpt` and `best.ckpt`, the results how it went and which to use."""
    check_numbers(config)
    L.seed_everything(config.seed, verbose=False)
    if config.trainer.threads is not None:
        torch.set_num_threads(config.trainer.threads)
    operator = build_operator(config, build_game(config))
    if config.trainer.compile and config.trainer.max_steps >= LONG:
        operator.compile_kernels()
    data = build_data(config, operator, label_progress())
    operator.seen_types, operator.config_hash, operator.seed = data.type_list, config_hash(config), config.seed
    check_validation(data.game, config.validation)
    every, stop = config.trainer.validate_every, config.validation.stop_when_safe
    validation = ClosedLoopValidation(folder, every, dt=config.evaluation.dt, stop=stop)
    trainer = build_trainer(config, folder, validation)
    if config.resume is not None:
        check_resumable(config.resume, operator)
    _take_over(None if config.resume is None else Path(config.resume).parent / BEST, folder / BEST)

    data.prepare_data()
    data.setup("fit")
    results.time("labels", data.label_seconds)
    results.update(label_statistics=label_statistics(data.extremals))
    if config.loss.scaled:
        operator.set_scales(Scales(*data.label_scales()))
    validation.begin(validation_labels(config, data, results))

    began = time.perf_counter()
    trainer.fit(operator, datamodule=data, ckpt_path=config.resume, weights_only=True)
    if config.trainer.polish:
        before, after = polish(operator, data.large_batch(trainer.global_step), config.trainer.polish)
        log.info("L-BFGS: loss %.4g, was %.4g", after, before)
        validation.consider(trainer, operator)
    # The callback saves at multiples of trainer.validate_every, which the last step need not be.
    trainer.save_checkpoint(folder / "last.ckpt", weights_only=False)
    results.time("training", time.perf_counter() - began - validation.seconds)
    results.time("validation", validation.seconds)
    losses = {name: float(value) for name, value in trainer.callback_metrics.items() if name.startswith("loss/")}
    metrics = {name: loss for name, loss in losses.items() if not math.isnan(loss)}
    metrics |= trainer.validate(operator, datamodule=data, verbose=False)[0]
    checkpoint = BEST if (folder / BEST).exists() else "last.ckpt"
    best = None if validation.best is None else validation.best._asdict()
    results.update(steps=trainer.global_step, checkpoint=checkpoint, metrics=metrics, validation=best)
    return trainer


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
            data.game, requests, data.cache, config.data.workers, label_progress(), clearance=clearance
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
