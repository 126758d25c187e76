"""Beliefs over the other players' types, with NumPy alone: the update, and one player's controller that has one."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from hno.runtime.artefact import Artefact

    Reals = NDArray[np.floating[Any]]


class Learning(NamedTuple):
    """How a belief follows what is seen.

    Controls are predictions plus white noise: what is learned in a second does not depend on how often it is learned.
    """

    noise: float = 0.01
    """Standard deviation of a control's mean over one second around the prediction, in widths of the control box."""
    memory: float = math.inf
    """Time after which what was learned counts 1/e, s: the prior of a step is raised to exp(-dt / memory)."""
    floor: float = 0.009
    """Least probability of a candidate in shares of an equal belief, 1 / K, before all are scaled to the sum 1: a
    belief that was wrong can recover, and however many candidates there are, little is believed of unlikely ones."""

    def check(self) -> None:
        """Refuse numbers that make no sense.

        Raises:
            ValueError: the message names the number.
        """
        if not self.noise > 0:
            raise ValueError(f"noise must be a positive number of widths of the control box; got {self.noise!r}.")
        if not self.memory > 0:
            raise ValueError(f"memory must be a positive time in s, or inf; got {self.memory!r}.")
        if not 0 <= self.floor < 1:
            raise ValueError(f"floor must be a share of an equal belief, from 0 to below 1; got {self.floor!r}.")

    def updated(self, belief: Reals, miss: Reals, dt: float) -> Reals:
        """The belief after one step, by Bayes' rule.

        A step with a miss that is not finite teaches nothing.

        Args:
            belief: probabilities of K candidates, (..., K).
            miss: controls that were seen minus predictions, in widths of the control box, (..., K, D).
            dt: time for which the controls were held, s.

        Raises:
            ValueError: dt is no positive time.
        """
        if not 0 < dt < math.inf:
            raise ValueError(f"dt must be a positive time, s; got {dt!r}.")
        seen = -dt / (2 * self.noise**2) * np.square(miss).sum(-1)
        seen = np.where(np.isfinite(seen).all(-1, keepdims=True), seen, 0)
        with np.errstate(divide="ignore"):
            weight = math.exp(-dt / self.memory) * np.log(belief) + seen
        found = np.maximum(_shares(np.exp(weight - weight.max(-1, keepdims=True))), self.floor / belief.shape[-1])
        return _shares(found)


def _shares(weights: Reals) -> Reals:
    return weights / weights.sum(-1, keepdims=True)


def distribution(prior: ArrayLike | None, shape: tuple[int, ...]) -> Reals:
    """A prior as probabilities of a shape whose last axis are candidates; equal ones of None.

    Raises:
        ValueError: it has another shape, or weights that are no distribution.
    """
    given = np.ones(shape[-1:]) if prior is None else np.asarray(prior, np.float64)
    try:
        weights = np.broadcast_to(given, shape)
    except ValueError:
        raise ValueError(
            f"The prior must have the shape {shape}, or one that is repeated to it; got {given.shape}."
        ) from None
    if not (np.isfinite(weights).all() and (weights >= 0).all() and (weights.sum(-1) > 0).all()):
        raise ValueError("The prior must be weights of at least 0, of which one at least is above 0.")
    return _shares(weights)


@final
class Believer:
    """The control loop of one player who learns the others' types: `act`, move, `observe`, and so on.

    It takes it that the others know all types, its own too; see `hno.control.belief`, whose `Believing` this is for one
    player and one state, with an exported controller.

    Args:
        artefact: the controller, of `hno.runtime.load`.
        player: which one it is, from 0.
        types: candidates for all players' types, (K, P); its own column holds its own type.
        acts: "mean" plays against the mean type, "mode" against the most likely candidate.
        learning: how the belief follows what is seen.
        prior: weights of the candidates, (K,); equal ones by default.

    Raises:
        ValueError: shapes, numbers or words that make no sense.
    """

    def __init__(
        self,
        artefact: Artefact,
        player: int,
        types: ArrayLike,
        acts: str = "mean",
        learning: Learning = Learning(),
        prior: ArrayLike | None = None,
    ) -> None:
        about, candidates = artefact.about, np.array(types, np.float32)
        if acts not in ("mean", "mode"):
            raise ValueError(f"acts must be one of mean, mode with an exported controller; got {acts!r}.")
        if not 0 <= player < about["players"]:
            raise ValueError(f"player must be from 0 to {about['players'] - 1}; got {player}.")
        if candidates.ndim == 2 and np.unique(candidates[:, player]).size != 1:
            raise ValueError(f"Column {player} of types holds the player's own type, the same in every row.")
        rows = np.concatenate([candidates, candidates[:1]]) if acts == "mean" else candidates
        self._many = artefact.many(rows)
        learning.check()
        self.belief = distribution(prior, (len(candidates),))
        self.types, self._player, self._learning, self._mean = candidates, player, learning, acts == "mean"
        self._predicted: Reals | None = None
        low, high = np.array(about["control_box"])
        self._others = np.delete(np.arange(about["players"]), player)
        self._width = np.broadcast_to(high - low, (about["players"], about["controls"]))[self._others]

    def act(self, tau: float, x: ArrayLike) -> Reals:
        """Its control (m,) with tau seconds to go at states (P, n). Raises as `Many`."""
        if self._mean:
            self._many.replace(len(self.types), self.belief @ self.types)
        answers = self._many(tau, x)
        self._predicted = answers[: len(self.types), self._others]
        return answers[-1 if self._mean else self.belief.argmax(), self._player]

    def observe(self, u: ArrayLike, dt: float) -> None:
        """What all players did since, (P, m), for dt, s; its own entry is not looked at.

        Raises:
            RuntimeError: it has not acted yet.
            ValueError: dt is no positive time.
        """
        if self._predicted is None:
            raise RuntimeError("Nothing was predicted yet: call `act` first.")
        miss = (np.asarray(u)[self._others] - self._predicted) / self._width
        self.belief = self._learning.updated(self.belief, miss.reshape(len(self.types), -1), dt)
