"""Lightning speaks of what goes wrong only."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

EXPECTED = (
    ".*exists and is not empty",  # results.json is there first, on purpose
    ".*isinstance.treespec, LeafSpec.",  # Lightning's own, from torch 2.13 on
    ".*does not have many workers",  # batches are made in memory
    ".*dirpath has changed",  # a run goes on in another folder
    ".*`srun` command is available",  # every process is there already
    ".*sync_dist=True",  # what is logged is of the whole batch, the same in every process
)
"""Warnings of Lightning that mean nothing here."""


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """No banner, tips or warnings that mean nothing here, in the block or the decorated function."""
    logger = logging.getLogger("lightning.pytorch")
    before = logger.level
    logger.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="|".join(EXPECTED))
            yield
    finally:
        logger.setLevel(before)
