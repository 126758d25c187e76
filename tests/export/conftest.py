from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from hno_examples.bicycle import Bicycle
from hno_examples.car_and_cyclist import CarAndCyclist
from hno_examples.three_walkers import ThreeWalkers

from hno.export import export, write
from hno.games import Game, make
from hno.operators import Architecture, Choice, ValueOperator, make_operator

OWN: dict[str, type[Game]] = {"bicycle": Bicycle, "three_walkers": ThreeWalkers, "car_and_cyclist": CarAndCyclist}
"""Games from outside the package."""


@functools.cache
def operator_of(case: str) -> ValueOperator:
    """A small operator with random weights: "game function activation members"."""
    game, function, activation, members = case.split()
    options = {"members": int(members)}
    parts = Choice(function, options), Choice("deeponet", {"width": 12, "depth": 3}), Choice(activation)
    torch.manual_seed(0)
    operator = apart(make_operator(OWN[game]() if game in OWN else make(game), Architecture(*parts)))
    operator.value_scale.fill_(40.0)
    return operator.eval().requires_grad_(False)


def apart(operator: ValueOperator) -> ValueOperator:
    """The same with branches apart, as after a few steps of training; random ones tie at a third of all states."""
    if operator.potential:  # the sides stand before the kind of function
        players, pairs = operator.game.players, operator.sides.shape[-1]
        for network in operator.networks:
            network.branch.layers[0].weight.data[:, -(1 + players) - pairs : -(1 + players)] *= 10
    return operator


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str, str], Path]]:
    """The folder of an exported controller, written once for each case and kind; each case is traced once."""

    @functools.cache
    def folder(case: str, kind: str) -> Path:
        return export(operator_of(case), kind, tmp_path_factory.mktemp("exported") / kind)

    with pytest.MonkeyPatch.context() as patch:
        for name in ("in_double", "programs"):
            patch.setattr(write, name, functools.cache(getattr(write, name)))
        yield folder
