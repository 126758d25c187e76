"""The potential W of a label set: its gradient is every player's own costate, which that of V_i is not."""

from __future__ import annotations

import functools

import pytest
import torch
from torch import Tensor

from hno.data.labels import Request, start_states
from hno.games import make
from hno.games.base import own_costate
from hno.pontryagin.solve import solve
from hno.types import Status, best_of

POTENTIAL_GAMES = ("narrow_road", "lane_change", "drone", "intersection")
STARTS, FEW = 24, 6
LEAD = 0.02
"""By which the best equilibrium must lead the second one, relative."""
STEP = 1e-4
"""Of the finite differences, in widths of the PDE box."""


@functools.cache
def slopes(name: str, starts: int = STARTS) -> dict[str, Tensor]:
    """Relative errors of costates as slopes of W and of V_i, along one random direction for each start."""
    game = make(name)
    x0 = start_states(game, Request((3.0, 3.0), 2 * starts, 3, "train"))
    theta = game.type_box.sample(len(x0), torch.Generator().manual_seed(1)).double()
    found = solve(game, x0, theta, all_equilibria=True)
    best, ranked = best_of(found), best_of(found).alternatives.nan_to_num(-torch.inf).sort(descending=True).values
    leads = ranked[:, 0] - ranked[:, 1] > LEAD * ranked[:, 0].abs()  # at a tie the best one might change
    alone = torch.bincount(found.start, minlength=len(x0)) == 1
    sound = ((alone | leads) & (best.status == Status.CONVERGED) & (best.clearance > 0)).nonzero().squeeze(-1)[:starts]
    assert len(sound) >= starts // 2
    direction = torch.randn(x0[sound].shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    direction = direction * game.state_box.width.double()
    after, before = (solve(game, x0[sound] + sign * STEP * direction, theta[sound]) for sign in (1, -1))
    costate = best.costate[sound, 0]
    own = own_costate(costate) * direction
    every = costate * direction.unsqueeze(1)
    change = (after.potential[:, 0] - before.potential[:, 0]) / (2 * STEP)
    changes = (after.value[:, 0] - before.value[:, 0]) / (2 * STEP)
    return {
        "W": (change - own.sum((1, 2))).abs() / own.abs().sum((1, 2)),
        "V": ((changes - every.sum((2, 3))).abs() / every.abs().sum((2, 3))).amax(1),
    }


@pytest.mark.parametrize(
    ("name", "starts"),
    [("narrow_road", FEW), *(pytest.param(name, STARTS, marks=pytest.mark.slow) for name in POTENTIAL_GAMES)],
)
def test_own_costates_are_the_gradient_of_the_potential(name: str, starts: int) -> None:
    """By finite differences over start states: the median error is far below a thousandth."""
    assert float(slopes(name, starts)["W"].median()) < 1e-3


@pytest.mark.parametrize(
    ("name", "starts"), [("narrow_road", FEW), pytest.param("lane_change", STARTS, marks=pytest.mark.slow)]
)
def test_costates_are_not_the_gradient_of_the_values(name: str, starts: int) -> None:
    """The others' reactions are in V_i, and are not in an open-loop costate."""
    assert float(slopes(name, starts)["V"].median()) > 0.02
