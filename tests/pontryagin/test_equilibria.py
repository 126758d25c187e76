"""All equilibria of a start: the best one first, the others equilibria too, and starts that stay together."""

from __future__ import annotations

import functools
import sys

import pytest
import torch
from torch import Tensor

from hno.data.labels import Request, start_states
from hno.games import make
from hno.games.potential import Team
from hno.pontryagin.newton import Newton
from hno.pontryagin.solve import Solver, solve
from hno.types import Extremal, Status, best_of, join, of_starts, part
from tests.crossing import Merging, Nearest
from tests.fakes import fake_labels
from tests.lq import random_game

STARTS = 6


@functools.cache
def solved(*, all_equilibria: bool) -> Extremal:
    """Cars that meet head-on and can pass on either side, in chunks of four and two starts."""
    game = make("narrow_road")
    x0 = start_states(game, Request((1.0, 4.0), STARTS, 3, "train"))
    theta = torch.tensor([[1.0, 4.0]]).expand(STARTS, -1)
    return solve(game, x0, theta, Solver(chunk=4), all_equilibria=all_equilibria)


def test_the_first_of_every_start_is_what_a_search_for_the_best_one_finds() -> None:
    best, every = solved(all_equilibria=False), solved(all_equilibria=True)
    assert best.start.tolist() == every.start.unique().tolist() == list(range(STARTS))
    for name, one, other in zip(Extremal._fields, best, best_of(every), strict=True):
        assert torch.equal(one.isnan(), other.isnan()), name
        assert torch.equal(one.nan_to_num(), other.nan_to_num()), name


def test_the_others_are_distinct_equilibria_in_the_order_of_their_cost() -> None:
    found = solved(all_equilibria=True)
    assert len(found.start) > STARTS
    assert found.status.tolist() == [Status.CONVERGED] * len(found.start)
    assert float(found.local_gap.max()) < 1e-4
    assert torch.equal(found.x[:, 0], best_of(found).x[found.start, 0])
    width = make("narrow_road").state_box.width.double()
    for start in range(STARTS):
        rows = (found.start == start).nonzero().squeeze(-1)
        assert torch.equal(rows, torch.arange(len(rows)) + rows[0]), "equilibria of one start follow each other"
        assert bool((found.cost[rows].diff() > 0).all())
        apart = (found.x[rows].unsqueeze(1) - found.x[rows]).abs() / width
        assert bool((apart.amax((2, 3, 4)) + torch.eye(len(rows)) > 1e-2).all())


def test_the_potential_is_what_the_team_gets() -> None:
    """At the end it is the sum of rewards; before it no less than the values', in which both pay the shared penalty."""
    found, game = solved(all_equilibria=True), make("narrow_road").double()
    torch.testing.assert_close(found.potential[:, -1], Team(game).terminal_value(found.x[:, -1]).squeeze(-1))
    assert bool((found.potential >= found.value.sum(-1) - 1e-9).all())


def test_a_game_that_is_no_potential_game_has_none() -> None:
    game = random_game(2)
    x0 = game.state_box.sample(2, torch.Generator().manual_seed(0))
    found = solve(game, x0, torch.zeros(2, 2), all_equilibria=True)
    assert bool(found.potential.isnan().all())
    assert found.start.tolist() == [0, 1], "a linear-quadratic game has one equilibrium"


class Claimed(Nearest):
    potential = True


def test_a_game_that_says_wrongly_that_it_has_a_potential_is_refused_before_anything_is_solved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    module = sys.modules[solve.__module__]  # the function has its name
    monkeypatch.setattr(module, "find_starts", lambda *arguments: pytest.fail("a search began"))
    game = Claimed()
    x0 = game.initial_box.sample(2, torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match=r"Claimed misses by .* set `potential = False`"):
        solve(game, x0, torch.ones(2, 3))


def test_where_nothing_converges_the_attempt_is_the_one_that_comes_closest() -> None:
    """Which here, for one state, is not the one that the search found the cheapest."""
    game, theta = make("lane_change"), torch.tensor([[5.0, 5.0]]).expand(2, -1)
    x0 = start_states(game, Request((5.0, 5.0), 2, 3, "train"))
    hasty = Solver(newton=Newton(steps=1, reuses=0, full_steps=0))
    one, every = (solve(game, x0, theta, hasty, all_equilibria=each) for each in (False, True))
    assert Status.CONVERGED not in one.status.tolist()
    assert every.start.tolist() == [0, 1]
    assert torch.equal(one.residual, every.residual)
    assert torch.equal(one.x, every.x)


class Unsolvable(Merging):
    """Costs that are not finite."""

    def penalty(self, x: Tensor, theta: Tensor) -> Tensor:
        return super().penalty(x, theta) * torch.nan


def test_a_start_without_an_equilibrium_has_its_best_attempt() -> None:
    game = Unsolvable(2)
    x0 = game.initial_box.sample(2, torch.Generator().manual_seed(0))
    found = solve(game, x0, torch.ones(2, 2), all_equilibria=True)
    assert found.start.tolist() == [0, 1]
    assert Status.CONVERGED not in found.status.tolist()


def several(*counts: int, seed: int = 0) -> Extremal:
    """So many equilibria of each start."""
    start = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    return fake_labels(make("narrow_road"), count=len(start), seed=seed)._replace(start=start)


def test_starts_are_counted_on_where_extremals_are_joined() -> None:
    one, other = several(2, 1, 3), several(1, 2, seed=1)
    both = join([one, other])
    assert both.start.tolist() == [0, 0, 1, 2, 2, 2, 3, 4, 4]
    assert (one.starts, other.starts, both.starts) == (3, 2, 5)
    assert torch.equal(both.x, torch.cat([one.x, other.x]))
    for first, ours in ((0, one), (3, other)):
        back = of_starts(both, first, first + ours.starts)
        assert all(map(torch.equal, back, ours))
    nothing = part(one, slice(0))
    assert nothing.starts == 0
    assert join([nothing, other]).start.tolist() == other.start.tolist()


@pytest.mark.parametrize(
    ("first", "end", "kept"), [(0, 1, [0, 1]), (1, 3, [2, 3, 4, 5]), (2, None, [3, 4, 5]), (3, None, [])]
)
def test_extremals_of_some_starts(first: int, end: int | None, kept: list[int]) -> None:
    found = several(2, 1, 3)
    some = of_starts(found, first, end)
    assert torch.equal(some.value, found.value[kept])
    assert some.start.tolist() == [int(start) - first for start in found.start[kept]]


def test_the_best_of_every_start_is_its_first() -> None:
    found = several(2, 1, 3)
    assert torch.equal(best_of(found).value, found.value[[0, 2, 3]])
    assert best_of(found).start.tolist() == [0, 1, 2]
    assert len(best_of(part(found, slice(0))).start) == 0
