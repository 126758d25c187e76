"""Where collocation points lie: sources of times and states, each a pure function of a generator."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, final

import torch
from torch import Tensor

from hno.games import Game
from hno.pontryagin.adjoint import gradient_of
from hno.registry import Registry, check_options
from hno.types import Points

sources: Registry[Source] = Registry("source", "hno.data", base="hno.data.sources:Source")


class Pool(NamedTuple):
    """Times and states to draw points around."""

    tau: Tensor
    """Times to go, (L,)."""
    x: Tensor
    """States, (L, P, n)."""


class Known(NamedTuple):
    """What a source may draw on besides the game."""

    labels: Pool | None
    """Nodes of labelled trajectories; None where nothing is labelled."""
    visited: Pool | None
    """Where the latest closed-loop validation went; None before the first."""


class Source(abc.ABC):
    """A distribution of collocation points. Constructor arguments are options."""

    needs_labels: ClassVar[bool] = False
    """Whether `Known.labels` must be there."""

    @abc.abstractmethod
    def draw(self, game: Game, theta: Tensor, window: float, known: Known, generator: torch.Generator) -> Points:
        """Points of given types.

        Args:
            game: the game.
            theta: type of each row, (B, P).
            window: share of the horizon that tau may reach.
            known: what is known so far.
            generator: source of randomness.

        Returns:
            Points in the PDE box, tau in the window, of the given types.
        """


@final
@sources.register("box")
class BoxSource(Source):
    """Uniform in the PDE box (the paper's)."""

    def draw(self, game: Game, theta: Tensor, window: float, known: Known, generator: torch.Generator) -> Points:
        """Uniform in time and state."""
        tau = window * game.horizon * torch.rand(len(theta), generator=generator)
        return Points(tau, game.state_box.sample(len(theta), generator), theta)


@final
@sources.register("band")
class BandSource(Source):
    """Near the surface constraint = 0.

    Args:
        reach: constraint values lie in [-reach, 0.2 reach], m for distance constraints.
    """

    def __init__(self, reach: float = 1.5) -> None:
        if not (math.isfinite(reach) and reach > 0):
            raise ValueError(f"sampler.band.reach must be a positive number; got {reach!r}.")
        self.reach = reach

    def draw(self, game: Game, theta: Tensor, window: float, known: Known, generator: torch.Generator) -> Points:
        """Uniform points, moved along the constraint's gradient."""
        points = BoxSource().draw(game, theta, window, known, generator)
        target = self.reach * (1.2 * torch.rand(len(theta), generator=generator) - 1)
        return points._replace(x=onto_band(game, points.x, theta, target))


@final
@sources.register("labels")
class LabelSource(Source):
    """Around nodes of labelled trajectories, at their times.

    Args:
        spread: standard deviation of what is added to states, in widths of the PDE box.
    """

    needs_labels = True

    def __init__(self, spread: float = 0.05) -> None:
        self.spread = _spread("labels", spread)

    def draw(self, game: Game, theta: Tensor, window: float, known: Known, generator: torch.Generator) -> Points:
        """Nodes within the window, with noise."""
        if known.labels is None:
            raise ValueError("The source 'labels' draws around labels, and nothing is labelled.")
        return around(game, known.labels, theta, window, self.spread, generator)


@final
@sources.register("rollout")
class RolloutSource(Source):
    """Around states that the latest closed-loop validation visited; around labels before the first one.

    Args:
        spread: as of `LabelSource`.
    """

    def __init__(self, spread: float = 0.05) -> None:
        self.spread = _spread("rollout", spread)

    def draw(self, game: Game, theta: Tensor, window: float, known: Known, generator: torch.Generator) -> Points:
        """Visited states within the window, with noise; uniform where there are neither visits nor labels."""
        pool = known.visited or known.labels
        if pool is None:
            return BoxSource().draw(game, theta, window, known, generator)
        return around(game, pool, theta, window, self.spread, generator)


class Share(NamedTuple):
    """A source, and how much of all points comes from it."""

    source: Source
    weight: float


Sampler = Mapping[str, Share]
"""Sources by name."""


def make_sampler(entries: Mapping[str, float | Mapping[str, Any]]) -> Sampler:
    """A mixture of registered sources.

    Args:
        entries: for each source its share, in any unit, or {share: ..., <option>: ...}.

    Raises:
        UnknownNameError: a source that is not registered, or an option that it does not know.
        ValueError: shares that are not finite, negative or all 0.
    """
    made = {}
    for name, entry in entries.items():
        cls = sources.get(name)
        options = dict(entry) if isinstance(entry, Mapping) else {"share": entry}
        share = options.pop("share", 0.0)
        check_options(f"source {name}", cls, options)
        made[name] = Share(cls(**options), share)
    shares = [share.weight for share in made.values()]
    sound = all(isinstance(s, (int, float)) and math.isfinite(s) and s >= 0 for s in shares)
    if not sound or sum(shares) <= 0:
        raise ValueError(
            f"Shares of the sampler's sources must be finite, not negative and not all 0; got {dict(entries)}."
        )
    return {name: share for name, share in made.items() if share.weight > 0}


def sample_points(
    game: Game, theta: Tensor, sampler: Sampler, known: Known, window: float, generator: torch.Generator
) -> Points:
    """Collocation points of given types (B, P) from a mixture of sources."""
    weights = torch.tensor([float(share.weight) for share in sampler.values()])
    chosen = torch.multinomial(weights, len(theta), replacement=True, generator=generator)
    tau, x = theta.new_empty(len(theta)), theta.new_empty(len(theta), game.players, game.state_dim)
    for number, share in enumerate(sampler.values()):
        rows = (chosen == number).nonzero().squeeze(-1)
        drawn = share.source.draw(game, theta[rows], window, known, generator)
        tau[rows], x[rows] = drawn.tau, drawn.x
    return Points(tau, x, theta)


def around(game: Game, pool: Pool, theta: Tensor, window: float, spread: float, generator: torch.Generator) -> Points:
    """Entries of a pool within the window, with noise; uniform points where there are none.

    Args:
        game: the game.
        pool: where to draw.
        theta: type of each row, (B, P).
        window: share of the horizon that tau may reach.
        spread: standard deviation, in widths of the PDE box.
        generator: source of randomness.
    """
    inside = (pool.tau <= window * game.horizon).nonzero().squeeze(-1)
    if len(inside) == 0:
        return BoxSource().draw(game, theta, window, Known(None, None), generator)
    row = inside[torch.randint(len(inside), (len(theta),), generator=generator)]
    noise = spread * torch.randn(pool.x[row].shape, generator=generator) * game.state_box.width
    return Points(pool.tau[row], game.state_box.clamp(pool.x[row] + noise), theta)


def onto_band(game: Game, x: Tensor, theta: Tensor, target: Tensor, iterations: int = 3) -> Tensor:
    """Move states until their largest constraint is about `target`, inside the PDE box.

    Args:
        game: the game.
        x: states, (B, P, n).
        theta: types, (B, P).
        target: constraint values to reach, (B,).
        iterations: Newton steps along the constraint's gradient, in box widths.
    """
    width = game.state_box.width
    for _ in range(iterations):
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            worst = game.constraint(x, theta).amax((-2, -1))
            slope = gradient_of(worst.sum(), x) * width
        size = slope.square().sum((-2, -1)).clamp_min(1e-12)
        step = ((target - worst.detach()) / size)[:, None, None] * slope * width
        x = game.state_box.clamp(x.detach() + step)
    return x.detach()


def _spread(name: str, spread: float) -> float:
    if not (math.isfinite(spread) and spread >= 0):
        raise ValueError(f"sampler.{name}.spread must be a finite number of at least 0; got {spread!r}.")
    return spread
