"""A policy that solves the rest of the game again while it plays."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hno.control.policy import Policy
from hno.games import Game
from hno.pontryagin.collocation import Iterate
from hno.pontryagin.newton import Newton
from hno.pontryagin.online import first_plan, planned_control, replan, subgame
from hno.pontryagin.solve import Solver

ONLINE = Solver(newton=Newton(tolerance=1e-6), extra_nodes=30)
"""Solver settings while playing: its errors are far below those of holding a control."""


class RecedingHorizon(Policy):
    """Controls of the open-loop equilibrium from the present states to the end of the game, solved again and again.

    The horizon shrinks with the time to go. An instance drives one batch of episodes: the first call searches from
    nothing, later ones start from the last plan (`hno.pontryagin.online.replan`). Rows that cannot be solved follow
    their last plan, or their best attempt if they have none, and are counted.

    Args:
        game: the game.
        interval: control steps from one solve to the next; in between the plan is followed.
        settings: solver settings.

    Raises:
        ValueError: the interval is not positive.
    """

    solves: Tensor
    """Solves of each row, (B,)."""
    searches: Tensor
    """Solves in which the last plan was no good start, so that several were searched, (B,)."""
    failures: Tensor
    """Solves without a solution, (B,)."""

    def __init__(self, game: Game, interval: int = 1, settings: Solver = ONLINE) -> None:
        if interval < 1:
            raise ValueError(f"The interval must be at least 1 control step; got {interval}.")
        self.game, self.interval, self.settings = game, interval, settings
        self._calls, self._tau = 0, math.inf
        self._plans: list[Iterate] = []

    def reset(self, x0: Tensor, theta: Tensor) -> None:
        """Forget the last episodes: the next call searches from nothing."""
        self._calls, self._tau, self._plans = 0, math.inf, []

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Controls in physical units, (B,), (B, P, n), (B, P) -> (B, P, m), in the floating-point type of `x`.

        Raises:
            ValueError: times to go differ between rows or do not fall from call to call; not the same batch as before.
        """
        self._tau = self._checked(tau, theta)
        with torch.inference_mode(False):
            rest = subgame(self.game, self._tau).to(x.device)
            if self._calls % self.interval == 0:
                self._solve(rest, x.detach().clone().double(), theta.detach().clone().double())
            self._calls += 1
            return torch.cat([planned_control(rest, plan) for plan in self._plans]).to(x.dtype)

    def _solve(self, rest: Game, x: Tensor, theta: Tensor) -> None:
        """Renew the plans, chunk by chunk, and count."""
        first, parts = not self._plans, x.split(self.settings.chunk)
        if first:
            types = theta.split(self.settings.chunk)
            plans = [first_plan(rest, *part, self.settings) for part in zip(parts, types, strict=True)]
            self.solves, self.searches, self.failures = torch.zeros(3, len(x), dtype=torch.int64, device=x.device)
        else:
            plans = [replan(rest, *part, self.settings) for part in zip(parts, self._plans, strict=True)]
        self._plans = [plan.at for plan in plans]
        self.solves += 1
        self.failures += torch.cat([plan.failed for plan in plans])
        if not first:
            self.searches += torch.cat([plan.searched for plan in plans])

    def _checked(self, tau: Tensor, theta: Tensor) -> float:
        now = float(tau[0])
        if bool((tau != now).any()):
            raise ValueError(f"All rows must have one time to go; got {float(tau.min()):g} to {float(tau.max()):g} s.")
        if not now < self._tau:
            raise ValueError(f"The time to go must fall from call to call; got {now:g} s after {self._tau:g} s.")
        if self._plans and not torch.equal(torch.cat([plan.theta for plan in self._plans]), theta.double()):
            raise ValueError("A receding-horizon policy drives one batch of episodes; make a new one for other rows.")
        return now
