from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hno.data import GameData
from hno.data.curriculum import Curriculum
from hno.games import Game, make
from tests.fakes import fake_labels

TYPES = ((1.0, 1.0), (5.0, 5.0), (1.0, 5.0), (2.0, 3.0))
MIXED = {"box": 0.4, "band": 0.3, "labels": 0.3}

MakeData = Callable[..., GameData]


@pytest.fixture
def make_data() -> MakeData:
    """A datamodule of four trajectories per type, one of them held out, on labels that were not solved."""

    def build(game: Game | None = None, **changes: Any) -> GameData:
        game = game if game is not None else make("narrow_road")
        arguments: dict[str, Any] = {
            "streams": {"bvp", "interior", "terminal"},
            "types": TYPES,
            "trajectories": 3,
            "cache": Path("unused"),
            "seed": 0,
            "batch_sizes": {"bvp": 32, "interior": 64, "terminal": 16},
            "curriculum": Curriculum(0, 10),
            "shares": MIXED,
            "validation": 1,
        }
        data = GameData(game, **(arguments | changes))
        data.extremals = [fake_labels(game, theta, seed=row) for row, theta in enumerate(data.type_list)]
        data.setup("fit")
        return data

    return build
