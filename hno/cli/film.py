"""The film of a training: a frame at every validation, in the run's folder and in the dashboards that take pictures."""

from __future__ import annotations

import logging
from pathlib import Path

import lightning as L
import numpy as np
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger

from hno.cli.media import harmless
from hno.control import Feedback
from hno.control.slices import Slice
from hno.evaluation.film import keep, shot
from hno.training.module import TrainingModule

log = logging.getLogger(__name__)


class Film(L.Callback):
    """Keeps a frame at every validation. A game without a slice has no film.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.rests = folder, False

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take a frame."""
        assert isinstance(pl_module, TrainingModule)
        if self.rests or trainer.sanity_checking:
            return
        try:
            found = shot(Feedback(pl_module.operator))
        except ValueError as error:
            self.rests = True
            log.info("There is no film: %s", error)
            return
        keep(found, trainer.global_step, self.folder)
        with harmless():
            _show(trainer, found)


def _show(trainer: L.Trainer, found: Slice) -> None:
    """A picture for the dashboards that take some."""
    takers = [one for one in trainer.loggers if isinstance(one, (TensorBoardLogger, WandbLogger))]
    if not takers:
        return
    from hno.report.slices import picture

    image = picture(found)
    for logger in takers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image("slice", np.asarray(image), trainer.global_step, dataformats="HWC")
        else:
            logger.log_image("slice", [image], trainer.global_step)
