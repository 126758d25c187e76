"""Errors off the labels, of value functions whose errors are known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.control import Feedback
from hno.evaluation.format import NOT_AVAILABLE
from hno.evaluation.landscape import landscape
from hno.evaluation.off_labels import OffLabels, errors, regions
from hno.games import Game, make
from hno.games.base import own_costate
from hno.types import Extremal, Field, Points, Status
from tests.fakes import fake_labels
from tests.operators.conftest import small_operator

SCALE = torch.tensor(1.0, dtype=torch.float64)
TAU = 1.0
"""Time to go, less than the whole game, s."""


def operator(game: Game, found: Extremal, factor: float) -> Any:
    """What says of the first nodes of equilibria that converged that much times the truth."""
    known = found.status == Status.CONVERGED

    def field(points: Points) -> Field:
        value, costate = found.value[known, 0], found.costate[known, 0]
        torch.testing.assert_close(points.x, found.x[known, 0])
        assert bool((points.tau == TAU).all())
        return Field(factor * value, value, factor * costate)

    return SimpleNamespace(game=game.double(), field=field, value_scale=SCALE)


@pytest.mark.parametrize("factor", [1.0, 1.25])
def test_errors_are_relative_to_the_truth_and_of_what_was_found(factor: float) -> None:
    game = make("narrow_road")
    status = [Status.CONVERGED] * 5 + [Status.STALLED]
    found = fake_labels(game, count=6, status=status, clearance=[1, 1, -1, -1, 1, 1])
    row = errors(operator(game, found, factor), found, TAU)
    assert (row["points"], row["solved"], row["safe"]) == (6, 5, 0.6)
    assert row["relative_value"] == pytest.approx(factor - 1)
    assert row["relative_gradient"] == pytest.approx(factor - 1)
    assert row["value_error"] == pytest.approx((factor - 1) * row["value"])


def test_gradients_are_measured_in_half_widths_of_the_box() -> None:
    """An error in one state weighs as much as a change of the value over half its range."""
    game = make("narrow_road").double()
    found, half, errs = fake_labels(game, count=3), game.state_box.width / 2, list[float]()
    slope = own_costate(found.costate[:, 0])
    size = (slope * half).flatten(1).norm(dim=-1).mean()
    for state in range(game.state_dim):
        off = torch.zeros_like(found.costate[:, 0])
        off[:, 0, 0, state] = 1.0
        field = Field(found.value[:, 0], found.value[:, 0], found.costate[:, 0] + off)
        wrong: Any = SimpleNamespace(game=game, field=lambda points, field=field: field, value_scale=SCALE)
        errs.append(errors(wrong, found, TAU)["relative_gradient"])
    assert errs == pytest.approx((half[0] / size).tolist())


def test_where_nothing_was_found_there_is_no_error() -> None:
    game = make("narrow_road")
    found = fake_labels(game, count=2, status=[Status.STALLED] * 2)
    row = errors(operator(game, found, 1.0), found, 1.0)
    (shown,) = OffLabels().rows([{"region": "PDE box", "tau": 1.0, **row}])
    texts = [column.format(shown[column.name]) for column in OffLabels.columns]
    assert texts[2:] == ["0", *[NOT_AVAILABLE] * 5]


def test_regions_are_where_their_names_say() -> None:
    game = make("narrow_road")
    types = torch.tensor([[1.0, 5.0]]).expand(64, -1)
    places = [(name, tau, x) for name, tau, x in regions(game, types, 0)]
    assert [(name, round(tau, 3)) for name, tau, _ in places] == [
        ("start box", 3), ("start box, twice as wide", 3), *[("PDE box", tau) for tau in (3, 2, 1)],
        *[("near the constraint", tau) for tau in (3, 2, 1)],
    ]  # fmt: skip
    start, wide, box, near = (places[k][2] for k in (0, 1, 2, 5))
    assert bool(game.initial_box.contains(start).all())
    assert not bool(game.initial_box.contains(wide).all())
    assert bool(game.initial_box.widened(2.0).contains(wide).all())
    assert bool(game.state_box.contains(box).all())
    distance = [game.constraint(x, types).amax((-1, -2)).abs().median() for x in (box, near)]
    assert distance[1] < distance[0] / 5


def test_the_types_that_are_evaluated_take_turns() -> None:
    game, asked = make("narrow_road"), list[tuple[float, Tensor]]()

    def equilibria(game: Game, x0: Tensor, theta: Tensor, tau: float) -> Extremal:
        asked.append((tau, theta))
        return fake_labels(game, count=len(x0), start=x0)

    policy = Feedback(small_operator("narrow_road").requires_grad_(False))
    evaluation: Any = SimpleNamespace(
        options={"off_labels": 3, "seed": 0}, game=game, types=[(1.0, 1.0), (5.0, 1.0)], equilibria=equilibria,
        policy=policy,
    )  # fmt: skip
    rows = OffLabels().compute(evaluation)
    assert [row["tau"] for row in rows] == [tau for tau, _ in asked]
    assert asked[0][1].tolist() == [[1, 1], [5, 1], [1, 1]]
    assert all(row["solved"] == 3 and row["relative_value"] > 0 for row in rows)


def test_a_controller_that_cannot_be_traced_has_pythons_values_and_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = Feedback(small_operator("narrow_road").requires_grad_(False))

    def refuse(learned: Any) -> None:
        raise RuntimeError("data-dependent control flow\nand a long trace")

    monkeypatch.setattr("hno.evaluation.landscape.page_program", refuse)
    content = landscape(policy)
    assert content["program"] is None
    assert content["reason"] == "RuntimeError: data-dependent control flow"
    assert len(content["python"]["value"]) == 2 * content["python"]["points"] ** 2
