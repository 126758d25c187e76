"""Linear-quadratic games and their exact solutions, by means that share nothing with the package's solver."""

from __future__ import annotations

from typing import NamedTuple

import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from hno.games import Box, Game


class LinearQuadratic(Game):
    """x_i' = A_i x_i + B_i u_i with J_i = int x' Q_i x + u_i' R_i u_i dt + x(T)' S_i x(T), x the joint state.

    The coupling x' Q_i x is a state cost, without any constraint that could be violated.

    Args:
        drift: A, (P, n, n).
        inputs: B, (P, n, m).
        weights: diagonal of R, (P, m).
        running: Q, symmetric, (P, P n, P n).
        terminal: S, symmetric, (P, P n, P n).
        horizon: s.
        label_step: s.
        reach: half width of the control box.
    """

    def __init__(
        self,
        drift: Tensor,
        inputs: Tensor,
        weights: Tensor,
        running: Tensor,
        terminal: Tensor,
        horizon: float = 1.0,
        label_step: float = 0.1,
        reach: float = 30.0,
    ) -> None:
        super().__init__()
        players, states, controls = inputs.shape
        self.roles = tuple(range(players))
        self.horizon, self.label_step = horizon, label_step
        for name, matrix in zip("abrqs", (drift, inputs, weights, running, terminal), strict=True):
            self.register_buffer(name, matrix)
        self.state_box = Box(-3 * torch.ones(players, states), 3 * torch.ones(players, states))
        self.initial_box = Box(-torch.ones(players, states), torch.ones(players, states))
        self.control_box = Box([-reach] * controls, [reach] * controls)
        self.type_box = Box([0.0] * players, [1.0] * players)

    def dynamics(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.einsum("pij,...pj->...pi", self.a, x) + torch.einsum("pik,...pk->...pi", self.b, u)

    def effort(self, u: Tensor) -> Tensor:
        return (self.r * u.square()).sum(-1)

    def terminal_value(self, x: Tensor) -> Tensor:
        return -quadratic(self.s, x)

    def state_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        return quadratic(self.q, x)

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        return torch.full_like(x[..., :1], -10)

    def positions(self, x: Tensor) -> Tensor:
        return x[..., :2]

    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        return self.control_box.clamp(torch.einsum("pik,...pi->...pk", self.b, own_costate) / (2 * self.r))

    @property
    def joint_drift(self) -> Tensor:
        """A of the joint state, (P n, P n)."""
        return torch.block_diag(*self.a)

    @property
    def gain(self) -> Tensor:
        """B_j R_j^-1 B_j' of every player, in joint coordinates, (P, P n, P n)."""
        blocks = torch.einsum("pik,pk,pjk->pij", self.b, 1 / self.r, self.b)
        empty = torch.zeros_like(blocks)
        return torch.stack([torch.block_diag(*empty[:j], block, *empty[j + 1 :]) for j, block in enumerate(blocks)])


def quadratic(forms: Tensor, x: Tensor) -> Tensor:
    """x' F_i x of the joint state, (P, P n, P n), (..., P, n) -> (..., P)."""
    joint = x.flatten(-2)
    return torch.einsum("...a,pab,...b->...p", joint, forms, joint)


def random_game(players: int, *, seed: int = 0, states: int = 2, **options: float) -> LinearQuadratic:
    """A game whose players differ in everything, float64."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def forms(scale: float) -> Tensor:
        root = normal(players, players * states, players * states)
        return scale * root @ root.mT / (players * states)

    drift, inputs = 0.7 * normal(players, states, states), normal(players, states, 1)
    weights = 0.5 + normal(players, 1).abs()
    return LinearQuadratic(drift, inputs, weights, forms(1.5), forms(1.0), **options).double()


class Solution(NamedTuple):
    """An open-loop Nash equilibrium, shapes as in `hno.types.Extremal`."""

    x: Tensor
    costate: Tensor
    u: Tensor
    value: Tensor


def open_loop_nash(game: LinearQuadratic, x0: Tensor, t: Tensor) -> Solution:
    """The equilibrium from the matrix exponential of the two-point boundary value problem.

    The unknowns are z = (x, lambda_1, ..., lambda_P) with z' = M z and lambda_i(T) = -2 S_i x(T).

    Args:
        game: the game.
        x0: initial states, (B, P, n).
        t: times, s, (K,).
    """
    players, states = game.players, x0.shape[-1]
    flow, size = flow_matrix(game), players * states
    whole = torch.linalg.matrix_exp(flow * game.horizon)
    end = 2 * game.s.flatten(0, 1)
    left = whole[size:, size:] + end @ whole[:size, size:]
    right = whole[size:, :size] + end @ whole[:size, :size]
    joint = x0.flatten(-2)
    start = torch.cat([joint, -torch.linalg.solve(left, right @ joint.mT).mT], -1)
    z = torch.einsum("kab,rb->rka", torch.linalg.matrix_exp(flow * t[:, None, None]), start)
    x = z[..., :size].unflatten(-1, (players, states))
    costate = z[..., size:].unflatten(-1, (players, players, states))
    own = costate.diagonal(dim1=-3, dim2=-2).mT
    u = torch.einsum("pik,...pi->...pk", game.b, own) / (2 * game.r)
    spent = torch.stack([spent_cost(game, flow, i, game.horizon - t, z) for i in range(players)], -1)
    return Solution(x, costate, u, -spent - quadratic(game.s, x[:, -1:]))


def flow_matrix(game: LinearQuadratic) -> Tensor:
    """M of z' = M z."""
    drift = game.joint_drift
    states = torch.cat([drift, *(game.gain / 2)], 1)
    adjoints = torch.cat([2 * game.q.flatten(0, 1), torch.block_diag(*[-drift.mT] * game.players)], 1)
    return torch.cat([states, adjoints])


def spent_cost(game: LinearQuadratic, flow: Tensor, player: int, time_left: Tensor, z: Tensor) -> Tensor:
    """int z' W_i z over the rest of the horizon by Van Loan's block exponential, (B, K)."""
    size = len(game.joint_drift)
    rate = torch.zeros_like(flow)
    rate[:size, :size] = game.q[player]
    own = slice(size * (1 + player), size * (2 + player))
    rate[own, own] = game.gain[player] / 4
    blocks = torch.cat([torch.cat([-flow.mT, rate], 1), torch.cat([torch.zeros_like(flow), flow], 1)])
    exponential = torch.linalg.matrix_exp(blocks * time_left[:, None, None])
    half = len(flow)
    integral = exponential[:, half:, half:].mT @ exponential[:, :half, half:]
    return torch.einsum("rka,kab,rkb->rk", z, integral, z)


def open_loop_riccati(game: LinearQuadratic) -> Tensor:
    """K_i(0) of lambda_i = -2 K_i x from the coupled open-loop Riccati equations, (P, P n, P n)."""
    a, shape = game.joint_drift, game.q.shape

    def rate(_: float, flat: Tensor) -> Tensor:
        k = torch.as_tensor(flat).view(shape)
        closed = torch.einsum("jab,jbc->ac", game.gain, k)
        return (game.q + a.mT @ k + k @ a - k @ closed).flatten().numpy()

    found = solve_ivp(rate, (0, game.horizon), game.s.flatten().numpy(), method="DOP853", rtol=1e-12, atol=1e-12)
    return torch.as_tensor(found.y[:, -1]).view(shape)


def feedback_riccati_rate(game: LinearQuadratic, k: Tensor) -> Tensor:
    """dK_i / dtau of the feedback Nash values V_i = -x' K_i x, (P, P n, P n)."""
    a = game.joint_drift
    closed = torch.einsum("jab,jbc->ac", game.gain, k)
    own = torch.einsum("iab,ibc,icd->iad", k, game.gain, k)
    return game.q + (a - closed).mT @ k + k @ (a - closed) + own
