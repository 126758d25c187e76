"""What makes one number of loss terms, and what it refuses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.losses import LossTerm, Norm, Objective, View, make_objective
from hno.registry import UnknownNameError

TERMS: Mapping[str, Mapping[str, Any]] = {"value": {}, "costate": {}, "residual": {}}
WEIGHTS = {"value": 1.0, "costate": 0.5, "residual": 0.1}


class Shifted(LossTerm):
    """Values minus a constant."""

    stream = "interior"

    def __init__(self, shift: float = 0.0) -> None:
        super().__init__()
        self.shift = shift

    def residual(self, view: View) -> Tensor:
        return view.field.value - self.shift

    def scale(self, view: View) -> Tensor:
        return view.scales.value


class Elsewhere(Shifted):
    stream = "nowhere"


@pytest.mark.parametrize(
    ("terms", "weights"),
    [
        (TERMS, WEIGHTS | {"boundary": 1.0}),
        (TERMS, {"value": 1.0}),
        (TERMS, WEIGHTS | {"valeu": 1.0}),
        ({}, WEIGHTS),
        (TERMS, {}),
        (TERMS, {"value": 1.0, "costate": 1.0, "boundary": 1.0}),
    ],
)
def test_terms_and_weights_must_be_of_the_same_names(
    terms: Mapping[str, Mapping[str, Any]], weights: Mapping[str, float]
) -> None:
    """A weight that nobody reads, or a term that silently weighs nothing, is a mistake; the message has both lists."""
    with pytest.raises(ValueError, match="Every loss term needs a weight and every weight a term") as error:
        make_objective(terms, weights)
    given, weighed = str(error.value).split(" and weights of ")
    assert all(name in given for name in terms)
    assert all(name in weighed for name in weights)


def test_a_term_that_is_not_registered_comes_with_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match=r"No loss named 'resdual'\. Known: .*value.* Did you mean 'residual'"):
        make_objective({"resdual": {}}, {"resdual": 1.0})


@pytest.mark.parametrize("name", ["value", "costate", "boundary", "residual"])
def test_an_option_that_a_term_does_not_know_is_refused(name: str) -> None:
    with pytest.raises(UnknownNameError, match=f"No option of loss {name} named 'foo'"):
        make_objective({name: {"foo": 1}}, {name: 1.0})


def test_a_stream_that_nobody_makes_is_refused() -> None:
    with pytest.raises(ValueError, match="mine reads the stream 'nowhere'; streams are bvp, interior, terminal"):
        Objective({"mine": Elsewhere()}, {"mine": 1.0})


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf])
def test_impossible_weights_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="must be finite, not negative and not all 0"):
        make_objective(TERMS, WEIGHTS | {"costate": bad})
    with pytest.raises(ValueError, match="must be finite, not negative and not all 0"):
        make_objective(TERMS, dict.fromkeys(TERMS, 0.0))


def test_terms_that_weigh_nothing_or_hold_anyway_are_not_used() -> None:
    terms: Mapping[str, Mapping[str, Any]] = {"value": {}, "boundary": {}, "residual": {}}
    objective = make_objective(terms, {"value": 1.0, "boundary": 1.0, "residual": 0.0})
    assert list(objective.used(exact_terminal=False)) == ["value", "boundary"]
    assert list(objective.used(exact_terminal=True)) == ["value"]
    only = make_objective({"boundary": {}}, {"boundary": 1.0})
    with pytest.raises(ValueError, match="No loss term is left to train with: boundary"):
        only.used(exact_terminal=True)


@pytest.mark.parametrize(("kind", "expected"), [("l1", 7 / 3), ("l2", 29 / 3), ("huber", (1.5 + 4.5) / 3)])
def test_norms_are_means_of_their_functions(kind: str, expected: float) -> None:
    residual = torch.tensor([0.0, -2.0, 5.0])
    assert float(Norm(kind)(residual)) == pytest.approx(expected)


def test_total_is_the_weighted_sum() -> None:
    objective = make_objective(TERMS, WEIGHTS)
    losses = {"value": torch.tensor(2.0), "costate": torch.tensor(4.0), "residual": torch.tensor(10.0)}
    assert float(objective.total(losses)) == pytest.approx(2 + 2 + 1)
    assert float(objective.total({"costate": losses["costate"]})) == pytest.approx(2)
