"""Certificates hold for solutions, and tell what is wrong with trajectories that are none."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.autograd.functional import hessian, jacobian

from hno.games import Box, ControlAffineGame, Game, make
from hno.pontryagin import Solver, solve
from hno.pontryagin.certificates import global_gap, local_gap, reintegration_error, replay
from hno.pontryagin.collocation import Collocation, Iterate
from hno.pontryagin.mesh import label_times
from hno.pontryagin.newton import Newton, newton
from hno.pontryagin.solve import solve_on_mesh
from hno.types import Status
from tests.lq import LinearQuadratic, open_loop_nash, quadratic, random_game
from tests.pontryagin.encounters import FIRST, starts, types


def terminal_game(label_step: float = 0.1) -> LinearQuadratic:
    """A random linear-quadratic game without running coupling: the penalty of the package's games is final."""
    game = random_game(2)
    return LinearQuadratic(game.a, game.b, game.r, 0 * game.q, game.s, label_step=label_step).double()


def solved(game: Game, rows: int = 4, settings: Solver = Solver()) -> Iterate:
    """Converged trajectories, on their meshes."""
    theta = game.type_box.lo.expand(rows, -1)
    found = solve_on_mesh(game, starts(game, rows), theta, settings)
    assert found.status.tolist() == [Status.CONVERGED] * rows
    return found.at


def shifted(at: Iterate, distance: float) -> Iterate:
    """The same controls after the start, from states that lie elsewhere."""
    z = at.z.clone()
    z[:, 1:, : z.shape[-1] // 2] += distance
    return at._replace(z=z)


def weakened(game: Game, at: Iterate, player: int, factor: float = 0.0) -> Iterate:
    """The own costates of one player, and with them its efforts, times a factor."""
    x, own = Collocation(game).split(at.z)
    scale = torch.ones(game.players, 1, dtype=own.dtype)
    scale[player] = factor
    return at._replace(z=torch.cat([x.flatten(-2), (scale * own).flatten(-2)], -1))


@pytest.mark.parametrize("players", [2, 3])
def test_replayed_controls_lead_to_the_exact_end_and_value(players):
    game = random_game(players)
    at = solved(game, settings=Solver(extra_nodes=100))
    exact = open_loop_nash(game, at.z[:, 0].unflatten(-1, (2, players, 2))[:, 0], at.t[0, [0, -1]])
    end, value = replay(game, at)
    torch.testing.assert_close(end, exact.x[:, -1], rtol=0, atol=1e-7)
    torch.testing.assert_close(value, exact.value[:, 0], rtol=0, atol=1e-7)
    assert reintegration_error(game, at).max() < 1e-7


@pytest.mark.parametrize("name", FIRST)
def test_states_that_the_controls_do_not_reach_have_a_large_reintegration_error(name):
    game = make(name).double()
    at = solved(game, 2)
    assert reintegration_error(game, at).max() < 1e-6
    assert reintegration_error(game, shifted(at, 0.1)).min() > 1e-3
    at.z[1] = torch.nan
    error = reintegration_error(game, at)
    assert error[0] < 1e-6
    assert error[1] == torch.inf


def test_the_reintegration_error_is_measured_in_widths_of_the_box():
    game = terminal_game()
    at = solved(game)
    at.z[:, -1, 1] += 0.3
    torch.testing.assert_close(reintegration_error(game, at), torch.full((4,), 0.3 / 6).double(), rtol=1e-4, atol=0)


@pytest.mark.parametrize("name", FIRST)
def test_no_player_gains_by_small_changes_of_a_solution(name):
    game = make(name).double()
    gap = local_gap(game, solved(game))
    assert gap.shape == (4, 2)
    assert (gap >= 0).all()
    assert gap.max() < 1e-4


def test_the_gap_of_a_solution_falls_with_the_fourth_power_of_the_mesh_width():
    gaps = [local_gap(game, solved(game, settings=Solver(extra_nodes=0))) for game in map(terminal_game, (0.1, 0.05))]
    assert 8 < gaps[0].max() / gaps[1].max() < 60
    assert gaps[1].max() < 1e-7


@pytest.mark.parametrize("player", [0, 1])
@pytest.mark.parametrize("name", FIRST)
def test_a_player_who_does_nothing_gains_much_by_acting(name, player):
    game = make(name).double()
    gap = local_gap(game, weakened(game, solved(game, 2), player))
    assert gap[:, player].min() > 1e-2


@pytest.mark.parametrize("player", [0, 1])
def test_only_the_player_who_deviates_has_a_gap_where_nothing_couples_the_players(player):
    game = make("drone").double()
    game.penalty_height = 1e-9
    gap = local_gap(game, weakened(game, solved(game, 2), player))
    assert gap[:, player].min() > 1e-2
    assert gap[:, 1 - player].max() < 1e-6


def exact_gain(game: LinearQuadratic, x0: Tensor, u: Tensor, player: int) -> Tensor:
    """What one player gains by its best reply to held controls (B, N, P, m), relative to its cost (at least 1), (B,).

    The states are linear in the controls, so that the cost is one dense quadratic form.
    """
    dt, size = game.horizon / u.shape[1], len(game.joint_drift)
    inputs = torch.block_diag(*game.b)
    generator = torch.cat([torch.cat([game.joint_drift, inputs], 1), inputs.new_zeros(u[0, 0].numel(), size + 2)])
    blocks = torch.linalg.matrix_exp(generator * dt)[:size]

    def cost(own: Tensor, row: int) -> Tensor:
        played, x = u[row].clone(), x0[row].flatten()
        played[:, player] = own
        for held in played.flatten(-2):
            x = blocks @ torch.cat([x, held])
        end = quadratic(game.s, x.view(x0.shape[1:]))[player]
        return (dt * game.effort(played)[:, player]).sum() + end

    gains = []
    for row in range(len(x0)):
        own = u[row, :, player]
        paid = cost(own, row)
        slope = jacobian(lambda at, row=row: cost(at, row), own).flatten()
        curve = hessian(lambda at, row=row: cost(at, row), own).view(len(slope), -1)
        gains.append(slope @ torch.linalg.solve(curve, slope) / 2 / paid.abs().clamp_min(1))
    return torch.stack(gains)


def test_the_local_gap_of_a_linear_quadratic_game_is_the_exact_gain():
    game = terminal_game()
    at = solved(game)
    centres = (torch.arange(40, dtype=torch.float64) + 0.5) / 40
    weak = torch.tensor([0.5, 1.2], dtype=torch.float64)
    x0 = at.z[:, 0, :4].unflatten(-1, (2, 2))
    u = weak.unsqueeze(-1) * open_loop_nash(game, x0, centres).u
    x, own = Collocation(game).split(at.z)
    found = local_gap(game, at._replace(z=torch.cat([x.flatten(-2), (weak.unsqueeze(-1) * own).flatten(-2)], -1)))
    exact = torch.stack([exact_gain(game, x0, u, player) for player in (0, 1)], -1)
    assert exact.amin(0).min() > 1e-5
    assert exact.amax(0).min() > 1e-2
    torch.testing.assert_close(found, exact, rtol=1e-2, atol=1e-6)


class Pillar(ControlAffineGame):
    """One point walks from 0 to 4 m and chooses its velocity; a pillar at (2, theta) m is in its way."""

    horizon = 1.0
    roles = (0,)

    def __init__(self) -> None:
        super().__init__()
        self.state_box = Box([[-1, -3]], [[5, 3]])
        self.initial_box = Box([[0, -0.02]], [[0.5, 0.02]])
        self.control_box = Box([-8, -8], [8, 8])
        self.type_box = Box([-1], [1])
        self.register_buffer("input_matrix", torch.eye(2))
        self.register_buffer("effort_weight", torch.ones(2))

    def drift(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def terminal_value(self, x: Tensor) -> Tensor:
        return -10 * (x[..., 0] - 4).square() - x[..., 1].square()

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        return 0.5 - (x - torch.stack([torch.full_like(theta, 2.0), theta], -1)).norm(dim=-1, keepdim=True)

    def sensors(self, theta: Tensor) -> Tensor:
        return theta.unsqueeze(-1)

    def positions(self, x: Tensor) -> Tensor:
        return x


def largest_global_gaps(game: Game, at: Iterate) -> Tensor:
    equations = Collocation(game)
    t = label_times(game, dtype=at.t.dtype, device=at.t.device)
    x, own = equations.split(equations.at_times(at, t.expand(len(at.t), -1)))
    return global_gap(game, x[:, 0], t, game.best_response(x, own), at.theta, Solver().search).amax(-1)


def test_passing_on_the_wrong_side_has_a_global_gap_but_no_local_one():
    """The way around a pillar on the left of the line is carried over to one on the right."""
    game = Pillar().double()
    x0, left, right = starts(game, 3), types(3, 0.2), types(3, -0.2)
    best = solve_on_mesh(game, x0, left).at
    found = newton(Collocation(game), best._replace(theta=right), Newton())
    wrong = Iterate(best.t, found.z, right)
    assert found.status.tolist() == [Status.CONVERGED] * 3
    assert largest_global_gaps(game, best).max() < 1e-3
    assert largest_global_gaps(game, wrong).min() > 0.1
    for at in (best, wrong):
        assert reintegration_error(game, at).max() < 1e-5
        assert local_gap(game, at).max() < 1e-6
    from_the_best = solve_on_mesh(game, x0, right).at
    paid = [-replay(game, at)[1][:, 0] for at in (wrong, from_the_best)]
    gained = (paid[0] - paid[1]) / paid[0].clamp_min(1)
    torch.testing.assert_close(largest_global_gaps(game, wrong), gained, rtol=0.1, atol=0)


class Stream(Pillar):
    """The point is carried towards the pillar."""

    def drift(self, x: Tensor) -> Tensor:
        return torch.tensor([4.0, 0.0], dtype=x.dtype).expand_as(x)


def test_only_a_manoeuvre_finds_the_way_around_a_pillar_straight_ahead():
    """By symmetry nothing pushes to either side: without manoeuvres the best answer is to stop before the pillar."""
    game = Stream().double()
    x0, theta = torch.tensor([[[0.0, 0.0]]], dtype=torch.float64), types(1, 0.0)
    t = label_times(game, dtype=torch.float64, device=x0.device)
    straight = torch.zeros(1, len(t), 1, 2, dtype=torch.float64)
    still = Solver().search._replace(amplitudes=(0.0,))
    around, before = (1 - global_gap(game, x0, t, straight, theta, search) for search in (Solver().search, still))
    assert around.item() < 0.3 * before.item()


def test_a_game_with_one_optimum_has_no_global_gap():
    game = terminal_game()
    found = solve(game, starts(game, 4), torch.zeros(4, 2))
    assert found.global_gap.max() < 1e-3


@pytest.mark.parametrize("name", FIRST)
def test_every_extremal_carries_its_certificates(name):
    game = make(name)
    found = solve(game, starts(game, 3), types(3, 1, 5))
    assert found.status.tolist() == [Status.CONVERGED] * 3
    assert found.reintegration.shape == (3,)
    assert found.local_gap.shape == found.global_gap.shape == (3, 2)
    for certificate in (found.reintegration, found.local_gap, found.global_gap):
        assert certificate.dtype == torch.float64
        assert certificate.isfinite().all()
        assert (certificate >= 0).all()
    assert found.reintegration.max() <= Solver().reintegration


@pytest.mark.slow
def test_the_label_is_among_its_alternatives_also_after_it_was_solved_again_on_its_kinks():
    game = make("drone")
    found = solve(game, starts(game, 16), types(16, 5, 5))
    solved = found.status == Status.CONVERGED
    apart = (found.alternatives - found.value[:, :1].sum(-1)).abs().nan_to_num(torch.inf).amin(-1)
    assert apart[solved].max() < 1e-9
    assert found.alternatives[~solved & (found.status != Status.INACCURATE)].isnan().all()


def test_a_row_whose_controls_lead_elsewhere_is_inaccurate():
    game = make("narrow_road")
    x0, theta = starts(game, 2), types(2, 1, 5)
    strict, usual = solve(game, x0, theta, Solver(reintegration=1e-14)), solve(game, x0, theta)
    assert strict.reintegration.min() > 1e-14
    assert strict.status.tolist() == [Status.INACCURATE] * 2
    assert usual.status.tolist() == [Status.CONVERGED] * 2
    torch.testing.assert_close(strict.value, usual.value, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("status", Status)
def test_every_status_says_what_to_do(status):
    assert len(status.advice) > 20
    assert [other.advice for other in Status].count(status.advice) == 1
