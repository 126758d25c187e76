"""Block elimination against dense algebra, and the interpolant against cubics."""

from __future__ import annotations

import pytest
import torch

from hno.games import make
from hno.pontryagin.collocation import Collocation, Ends, Iterate, hermite
from hno.pontryagin.elimination import Elimination, eliminate
from hno.pontryagin.newton import Newton, newton
from hno.pontryagin.solve import solve_on_mesh
from hno.types import Status
from tests.lq import LinearQuadratic
from tests.pontryagin.encounters import starts, types


def system(rows: int, intervals: int, half: int) -> tuple[torch.Tensor, ...]:
    """Random blocks and right-hand sides: left, right, slope at the end, defect, terminal defect."""
    generator, size = torch.Generator().manual_seed(0), 2 * half
    shapes = [(intervals, size, size)] * 2 + [(half, half), (intervals, size), (half,)]
    return tuple(torch.randn(rows, *shape, generator=generator, dtype=torch.float64) for shape in shapes)


def dense_step(left, right, end, defect, terminal):
    """The same linear system as one matrix, solved at once."""
    rows, intervals, size = defect.shape
    half, total = size // 2, (intervals + 1) * size
    matrix, known = left.new_zeros(rows, total, total), left.new_zeros(rows, total)
    matrix[:, :half, :half] = torch.eye(half, dtype=left.dtype)
    for k in range(intervals):
        place = slice(half + k * size, half + (k + 1) * size)
        matrix[:, place, k * size : (k + 1) * size] = left[:, k]
        matrix[:, place, (k + 1) * size : (k + 2) * size] = right[:, k]
        known[:, place] = -defect[:, k]
    matrix[:, -half:, -size:-half] = -end
    matrix[:, -half:, -half:] = torch.eye(half, dtype=left.dtype)
    known[:, -half:] = -terminal
    return torch.linalg.solve(matrix, known).unflatten(-1, (intervals + 1, size))


@pytest.mark.parametrize(("intervals", "half"), [(1, 1), (4, 3), (12, 2)])
def test_elimination_solves_the_block_system(intervals, half):
    left, right, end, defect, terminal = system(5, intervals, half)
    found = eliminate(left, right, end).solve(defect, terminal)
    exact = dense_step(left, right, end, defect, terminal)
    assert (found[:, 0, :half] == 0).all()
    torch.testing.assert_close(found, exact, rtol=1e-8, atol=1e-8 * float(exact.abs().max()))


def test_rows_of_an_elimination_are_systems_of_their_own():
    left, right, end, defect, terminal = system(5, 6, 2)
    rows, whole = torch.tensor([3, 1]), eliminate(left, right, end)
    assert isinstance(whole.rows(rows), Elimination)
    found = whole.rows(rows).solve(defect[rows], terminal[rows])
    torch.testing.assert_close(found, whole.solve(defect, terminal)[rows])


def test_hermite_is_the_cubic_through_values_and_rates():
    weights = torch.tensor([1.0, -2.0, 0.5, 3.0], dtype=torch.float64)

    def cubic(t):
        return (weights * t.unsqueeze(-1) ** torch.arange(4)).sum(-1)

    def rate(t):
        return (weights[1:] * torch.tensor([1, 2, 3]) * t.unsqueeze(-1) ** torch.arange(3)).sum(-1)

    left, step = torch.tensor([-1.0, 0.2], dtype=torch.float64), torch.tensor([0.7, 1.3], dtype=torch.float64)
    ends = Ends(cubic(left), cubic(left + step), rate(left), rate(left + step))
    for share in torch.linspace(0, 1, 7, dtype=torch.float64):
        torch.testing.assert_close(hermite(ends, step, share), cubic(left + share * step), rtol=0, atol=1e-13)


def straight_costates() -> LinearQuadratic:
    """Two double integrators without coupling: costates are linear in time, velocities quadratic, places cubic."""
    drift = torch.tensor([[0.0, 1.0], [0.0, 0.0]], dtype=torch.float64).expand(2, 2, 2)
    inputs = torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, 2, 1)
    return LinearQuadratic(drift, inputs, drift.new_ones(2, 1), *[drift.new_zeros(2, 4, 4)] * 2).double()


def cubic_path(t: torch.Tensor) -> torch.Tensor:
    """A trajectory of the game above that satisfies Pontryagin's equations, (..., K) -> (..., K, 8)."""
    place, speed, push, slope = torch.tensor([[1.0, -0.5], [0.3, 0.2], [2.0, -1.0], [3.0, 4.0]], dtype=t.dtype)
    t = t.unsqueeze(-1)
    x = torch.stack(
        [place + speed * t + push * t**2 / 4 - slope * t**3 / 12, speed + push * t / 2 - slope * t**2 / 4], -1
    )
    own = torch.stack([slope.expand_as(push * t), push - slope * t], -1)
    return torch.cat([x.flatten(-2), own.flatten(-2)], -1)


def test_the_interpolant_and_the_equations_are_exact_for_cubics():
    equations = Collocation(straight_costates())
    t = torch.tensor([[0.0, 0.1, 0.35, 0.5, 1.0], [0.0, 0.4, 0.45, 0.9, 1.0]], dtype=torch.float64)
    at = Iterate(t, cubic_path(t), torch.zeros(2, 2, dtype=t.dtype))
    share, asked = torch.rand(6, generator=torch.Generator().manual_seed(0)).double(), torch.linspace(0, 1, 33).double()
    inner = t[:, :-1, None] + share * t.diff(dim=-1).unsqueeze(-1)
    torch.testing.assert_close(equations.interpolate(at, share), cubic_path(inner), rtol=0, atol=1e-13)
    torch.testing.assert_close(equations.at_times(at, asked.expand(2, -1)), cubic_path(asked.expand(2, -1)))
    assert equations.defect(at).abs().max() < 1e-14


def test_intervals_of_length_zero_change_nothing():
    """At the end, and in the middle."""
    game = make("narrow_road").double()
    found = solve_on_mesh(game, starts(game, 3), types(3, 1, 5))
    assert (found.status == Status.CONVERGED).all()
    nodes = found.at.t.shape[1]
    places = torch.tensor([*range(nodes), nodes - 1, nodes - 1, nodes // 2]).sort().values
    once = torch.cat([torch.tensor([True]), places.diff() > 0])
    rough = found.at._replace(z=found.at.z * torch.tensor(1.001).double())
    rough.z[:, 0, :8] = found.at.z[:, 0, :8]
    equations = Collocation(game)
    plain = newton(equations, rough, Newton())
    padded = newton(equations, Iterate(rough.t[:, places], rough.z[:, places], rough.theta), Newton())
    assert (padded.status == Status.CONVERGED).all()
    torch.testing.assert_close(padded.z[:, once], plain.z, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(padded.z[:, ~once], plain.z[:, places[~once]], rtol=1e-7, atol=1e-7)
    asked = torch.linspace(0, game.horizon, 50, dtype=torch.float64).expand(3, -1)
    lengthened = Iterate(rough.t[:, places], plain.z[:, places], rough.theta)
    once_each = equations.at_times(rough._replace(z=plain.z), asked)
    torch.testing.assert_close(equations.at_times(lengthened, asked), once_each)
