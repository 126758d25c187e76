from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
import yaml
from hydra._internal.hydra import Hydra

from hno.data.labels import Request, labels_for
from hno.games import make
from hno.types import Extremal

TRAIN = Request((1.0, 1.0), 4, 0, "train")
"""Labels that every test shares."""
SMOKE = TRAIN._replace(all_equilibria=True)
"""Those of `experiment=smoke data.types=[[1,1]]`, which learns a potential."""
TEST = Request((1.0, 1.0), 4, 1000, "test")
"""Test starts of that configuration."""


@pytest.fixture(scope="session", autouse=True)
def settings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """One thread, a cache of labels that all workers of one test run share, and no W&B account.

    Hydra reads yaml in C, and does not compose a configuration once more to see `hydra.mode`, which ours never set.
    """
    torch.set_num_threads(1)
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HNO_CACHE", str(shared / "labels"))
        patch.setenv("NETRC", str(shared / "no-netrc"))
        patch.setattr(yaml, "SafeLoader", yaml.CSafeLoader)
        patch.setattr(Hydra, "get_mode", lambda *arguments, **options: None)
        for name in ("WANDB_API_KEY", "WANDB_MODE", "HYDRA_FULL_ERROR"):
            patch.delenv(name, raising=False)
        yield


@pytest.fixture(scope="session")
def cache(settings: None) -> Path:
    """The folder of label files of this test run."""
    return Path(os.environ["HNO_CACHE"])


@pytest.fixture(scope="session")
def labels(cache: Path) -> Callable[[str, Request], Extremal]:
    """Labels of a game, solved once per test run."""

    def solved(game: str, request: Request = TRAIN) -> Extremal:
        return labels_for(make(game), [request], cache, workers=1)[0][0]

    return solved
