"""Starts at which two ways around each other cost nearly the same."""

from __future__ import annotations

import functools

import pytest
import torch
from torch import Tensor

from hno.data import ties
from hno.data.labels import Request, provenance, start_states
from hno.data.ties import TIE, TooFewTiesError, tie_states, tied
from hno.games import make
from hno.pontryagin.solve import Solver, solve
from hno.types import Extremal, Status
from tests.fakes import fake_labels
from tests.walkers import Walkers

TYPES = (1.0, 1.0)
REQUEST = Request(TYPES, 2, 0, "test", ties=True)


@pytest.fixture(autouse=True)
def few_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ties, "BATCH", 3)


@functools.cache
def states(count: int) -> Tensor:
    """Ties of pedestrians who meet head-on."""
    return start_states(Walkers(), REQUEST._replace(starts=count))


def test_the_two_best_equilibria_of_a_tie_cost_nearly_the_same() -> None:
    game, x0 = Walkers(), states(2)
    assert x0.dtype == torch.float64
    assert x0.shape == (2, 2, 2)
    assert bool(game.initial_box.contains(x0.float()).all())
    found = solve(game, x0, torch.tensor([TYPES]).expand(2, -1), all_equilibria=True)
    assert tied(found).tolist() == [True, True]
    for start in range(2):
        rows = (found.start == start) & (found.status == Status.CONVERGED)
        first, second = found.cost[rows].sort().values[:2]
        assert second - first <= TIE * first


@pytest.mark.slow
def test_more_ties_begin_with_the_fewer() -> None:
    assert torch.equal(states(1), states(2)[:1])


@pytest.mark.slow
def test_ties_do_not_depend_on_how_many_pairs_are_tried_together(monkeypatch: pytest.MonkeyPatch) -> None:
    once = states(1)
    monkeypatch.setattr(ties, "BATCH", 5)
    again = start_states(Walkers(), REQUEST._replace(starts=1))
    torch.testing.assert_close(again, once, rtol=0, atol=1e-9)


def test_a_game_that_hardly_has_any_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """All starts are one here, so that no two go different ways."""
    monkeypatch.setattr(ties, "MOST", 1)
    drawn: list[int] = []

    def draw(size: int) -> Tensor:
        drawn.append(size)
        return torch.zeros(size, 2, 2, dtype=torch.float64)

    with pytest.raises(TooFewTiesError, match=r"Walkers has 0 ties of two equilibria in 3 pairs .*2 were asked for"):
        tie_states(Walkers(), TYPES, 2, draw, Solver())
    assert drawn == [6]


def of_costs(*costs: tuple[float, ...]) -> Extremal:
    """Equilibria of one start after the other with these joint costs; nan: it did not converge."""
    start = torch.arange(len(costs)).repeat_interleave(torch.tensor([len(each) for each in costs]))
    cost = torch.tensor([one for each in costs for one in each], dtype=torch.float64)
    failed = [Status.STALLED if one else Status.CONVERGED for one in cost.isnan().tolist()]
    found = fake_labels(make("narrow_road"), count=len(start), status=failed)
    value = found.value.clone()
    value[:, 0] = -cost.nan_to_num(7.0).unsqueeze(-1) / 2
    return found._replace(start=start, value=value)


def test_a_start_is_tied_by_its_two_cheapest_converged_equilibria() -> None:
    found = of_costs((10.0, 10.05), (10.0, 10.2), (10.0,), (10.2, 20.0, 10.15), (10.0, torch.nan), (10.0, 12.0, 12.01))
    assert tied(found).tolist() == [True, False, False, True, False, False]
    assert tied(of_costs((10.0,), (9.0,))).tolist() == [False, False]


def test_one_player_has_no_ties_and_nothing_is_solved() -> None:
    def draw(size: int) -> Tensor:
        raise AssertionError("a start was drawn")

    game = Walkers()
    game.roles = (0,)
    with pytest.raises(TooFewTiesError, match="has 0 ties"):
        tie_states(game, (0.0,), 3, draw)


def test_sets_of_ties_are_kept_under_what_a_tie_is(monkeypatch: pytest.MonkeyPatch) -> None:
    game, request = make("narrow_road"), Request((3.0, 3.0), 2, 0, "test", ties=True)
    before = provenance(game, request, Solver())
    monkeypatch.setattr("hno.data.labels.TIE", 0.02)
    assert provenance(game, request, Solver()) != before
    plain = request._replace(ties=False)
    assert "ties" not in provenance(game, plain, Solver())["request"]
