"""Exact potential games: one optimal control problem whose solutions are equilibria (Monderer and Shapley 1996)."""

from __future__ import annotations

import copy
from typing import Protocol

import torch
from torch import Tensor

from hno.games.base import Game


class Problem(Protocol):
    """What a value function with costates dV_q / dx_j, (B, Q, P, n), solves the Hamilton-Jacobi equation of.

    A game is the problem of its players' values, Q = P; `Team` is that of a potential, Q = 1.
    """

    def optimal_control(self, x: Tensor, costate: Tensor) -> Tensor:
        """Every player's control, (B, P, n), (B, Q, P, n) -> (B, P, m)."""

    def hamiltonian(self, x: Tensor, costate: Tensor, u: Tensor, theta: Tensor) -> Tensor:
        """Flow along the costates minus running costs, (B, Q)."""

    def uncontrolled_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        """Running cost without efforts, 1/s, (B, Q)."""

    def terminal_value(self, x: Tensor) -> Tensor:
        """Reward at the end, (B, Q)."""


class Team(Problem):
    """All players of a potential game as one, who maximises the potential W.

    W(tau, x) = max over all controls of sum_i (terminal value - efforts) - integral of `Game.potential_cost`. Players
    who deviate alone gain what W gains, so its optimal controls are an open-loop equilibrium, and dW / dx_i is the
    costate of player i with respect to its own state.

    Args:
        game: a potential game.

    Raises:
        ValueError: the game is none.
    """

    def __init__(self, game: Game) -> None:
        require_potential(game)
        self.game = game

    def optimal_control(self, x: Tensor, costate: Tensor) -> Tensor:
        """Every player's best response to dW / dx_i, (B, P, n), (B, 1, P, n) -> (B, P, m)."""
        return self.game.best_response(x, costate.squeeze(-3))

    def hamiltonian(self, x: Tensor, costate: Tensor, u: Tensor, theta: Tensor) -> Tensor:
        """sum_i <dW/dx_i, f_i> - efforts - cost of states, (B, 1)."""
        flow = (costate * self.game.dynamics(x, u).unsqueeze(-3)).sum((-2, -1))
        return flow - self.running_cost(x, u, theta)

    def running_cost(self, x: Tensor, u: Tensor, theta: Tensor) -> Tensor:
        """Efforts of all players and the cost of states, 1/s, (B, 1)."""
        return self.game.effort(u).sum(-1, keepdim=True) + self.uncontrolled_cost(x, theta)

    def uncontrolled_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        """`Game.potential_cost`, 1/s, (B, 1)."""
        return self.game.potential_cost(x, theta).unsqueeze(-1)

    def terminal_value(self, x: Tensor) -> Tensor:
        """Sum of the players' rewards, (B, 1)."""
        return self.game.terminal_value(x).sum(-1, keepdim=True)


def require_potential(game: Game) -> None:
    """Refuse a game that does not say that it is a potential game, or whose costs show that it is none.

    Raises:
        ValueError: the message says what a potential game is and what to do.
    """
    gap = potential_gap(game) if game.potential else torch.inf
    if gap > GAP:
        found = f"misses by {gap:.3g} of the cost" if game.potential else "does not say that it is one (`potential`)"
        raise ValueError(
            f"{type(game).__name__} {found}: in a potential game a player who deviates alone changes its own running "
            "cost as much as `potential_cost`, and its own reward at the end as much as the sum of all. State that "
            "method and `potential = True`, or set `potential = False` and learn the players' values (function=value)."
        )


GAP = 1e-5
"""Relative difference up to which two changes of cost are equal, in single precision too."""


def potential_gap(game: Game, size: int = 512) -> float:
    """How far a game is from a potential game with its `potential_cost`, by random deviations of single players.

    Returns:
        The largest difference between the change of the deviator's cost and that of the potential, running or terminal,
        relative to the largest cost among the points.
    """
    game, generator = copy.deepcopy(game).cpu(), torch.Generator().manual_seed(0)
    x, moved, theta = (box.sample(size, generator) for box in (game.state_box, game.state_box, game.type_box))
    worst = 0.0
    for player in range(game.players):
        deviated = torch.cat([x[:, :player], moved[:, player : player + 1], x[:, player + 1 :]], 1)
        running = [(game.uncontrolled_cost(at, theta), game.potential_cost(at, theta)) for at in (x, deviated)]
        terminal = [(game.terminal_value(at), game.terminal_value(at).sum(-1)) for at in (x, deviated)]
        for (own, shared), (own_after, shared_after) in (running, terminal):
            gap = (own_after - own)[:, player] - (shared_after - shared)
            worst = max(worst, float(gap.abs().max() / (1e-6 + own.abs().max())))
    return worst
