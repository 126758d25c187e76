"""Bounds on the probability of collision from independent closed-loop tests, each with a stated confidence.

Starts and types are drawn anew, uniformly, and played. How many collide is binomial, whose exact upper bound (Clopper
and Pearson 1934) needs no model of the controller and no asymptotics. The tests must not have chosen the controller.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hno.control import Feedback
from hno.control.rollout import Disturbance, rollout
from hno.data.certificates import CLEARANCE, safe
from hno.evaluation.closed_loop import AT_ONCE
from hno.evaluation.metrics import in_batches, lower_bound, upper_bound
from hno.games import Game
from hno.types import Extremal, Field, Points, PotentialField, Status

SPLIT, LEVELS = "certify", "certify levels"
"""Random numbers of the tests, and of the starts that choose margin and levels: nothing else draws from them."""
SUBSTEPS, POINTS = 4, 4
"""Runge-Kutta steps while a control is held, and states within each at which collisions are looked for."""
SHARES = tuple(k / 50 for k in range(1, 51))
"""Shares of all starts that the candidates for a safe region have."""

Solve = Callable[[Tensor, Tensor], Extremal]
"""Equilibria from start states (B, P, n) and types (B, P), one each."""


class Plan(NamedTuple):
    """What is tested, and how surely the bounds are to hold."""

    tests: int = 3000
    """Independent episodes."""
    beta: float = 1e-3
    """Probability with which a bound may be wrong."""
    seed: int = 314159
    """Of starts, types and noise."""
    dt: float = 0.02
    """Time for which a control is held, s."""
    clearance: float = CLEARANCE
    """What the equilibrium of a safe start keeps, in the unit of the game's constraint."""
    equilibria: int | None = 500
    """The first tests, so many, whose equilibrium is solved whatever comes of them; None for all, 0 for no bound over
    safe starts."""
    target: float = 0.01
    """Probability of collision up to which a region of starts counts as safe."""
    types: Sequence[Sequence[float]] | None = None
    """Types, each as likely; None for all of the type box."""
    noise: float = 0.0
    """Of controls, as of `Disturbance`."""
    delay: int = 0
    """Steps by which controls come late."""

    def check(self) -> None:
        """Raise ValueError for numbers that make no statement."""
        if type(self.tests) is not int or self.tests < 1:
            raise ValueError(f"tests must be a whole number of at least 1; got {self.tests!r}.")
        for name in ("beta", "target"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(
                    f"{name} must be a probability between 0 and 1, without these; got {getattr(self, name)!r}."
                )


class Trials(NamedTuple):
    """Independent episodes."""

    x0: Tensor
    """Start states, (N, P, n)."""
    theta: Tensor
    """Types, (N, P)."""
    collided: Tensor
    """Whether they collide, or do not stay finite, bool, (N,)."""


class Bound(NamedTuple):
    """The probability of collision of a random start."""

    tests: int
    collisions: int
    bound: float
    """Exceeded by the probability with a probability of at most beta."""


class SafeBound(NamedTuple):
    """The probability of collision of a random start, given that its equilibrium keeps a clearance.

    A start whose equilibrium was not found may be one of these or not. The second bound takes whichever is worse: those
    that collide count, the others do not.
    """

    clearance: float
    solved: int
    """Tests, the first ones, whose equilibrium was asked for whatever came of them; it was for every collision too."""
    safe: int
    """Those of them whose equilibrium keeps the clearance."""
    unsolved: int
    """Those of them whose equilibrium was not found."""
    collisions: int
    """Tests that collide although the equilibrium keeps the clearance."""
    unsolved_collisions: int
    """Tests that collide and whose equilibrium was not found."""
    bound: float
    """Over starts whose equilibrium is found and keeps the clearance."""
    worst_bound: float
    """Over starts whose equilibrium keeps the clearance, found or not."""


class Region(NamedTuple):
    """The starts with a margin of at least a level, which collide with a probability of at most `target`."""

    margin: str
    """One of `MARGINS`."""
    level: float | None
    """None for every start."""
    target: float
    tests: int
    """Tests that start in it."""
    collisions: int
    """Those of them that collide."""
    share: float
    """Of all tests that start in it."""


class Certificate(NamedTuple):
    """Bounds from the same tests; each holds with confidence 1 - beta, all together with 1 - (their number) beta."""

    plan: Plan
    every: Bound
    """Over all starts."""
    safe: SafeBound | None
    """Over those whose equilibrium is safe; None where it was not asked for."""
    region: Region | None
    """None where no region was found."""

    @property
    def statements(self) -> int:
        """How many statements are made."""
        return 2 + (0 if self.safe is None else 2)


def certify(policy: Feedback, plan: Plan, solve: Solve) -> Certificate:
    """Test a controller of all players.

    Args:
        policy: the controller, which no test may have chosen.
        plan: what is tested.
        solve: gives equilibria, such as `hno.data.many.solve_many` of the game.

    Raises:
        ValueError: a plan that makes no statement, or as `rollout`.
    """
    plan.check()
    chosen, tests = play(policy, plan, LEVELS), play(policy, plan, SPLIT)
    count, hits = len(tests.collided), int(tests.collided.sum())
    known = None if plan.equilibria == 0 else safe_bound(tests, plan, solve)
    found = region(policy, chosen, tests, plan)
    return Certificate(plan, Bound(count, hits, upper_bound(hits, count, plan.beta)), known, found)


def draw(
    game: Game, count: int, seed: int, split: str, types: Sequence[Sequence[float]] | None = None
) -> tuple[Tensor, Tensor]:
    """Independent uniform starts of the start box and types; more of them begin with the fewer.

    A counter-based generator (Philox 4x64-10) has a hash of seed and split as its key. Labels, batches and rounds draw
    from a generator of another kind (Mersenne twister), which cannot repeat it.

    Returns:
        States (count, P, n) and types (count, P).
    """
    key = hashlib.sha256(f"{split}:{seed}".encode()).digest()[:16]
    players, states = game.players, game.state_dim
    unit = np.random.Generator(np.random.Philox(key=int.from_bytes(key))).random((count, players * (states + 1)))
    own, kinds = torch.from_numpy(unit).split([players * states, players], -1)
    box, kind = game.initial_box, game.type_box
    x0 = box.lo + own.unflatten(-1, (players, states)).to(box.lo) * box.width
    if types is None:
        return x0, kind.lo + kinds.to(kind.lo) * kind.width
    return x0, x0.new_tensor(types)[(kinds[:, 0] * len(types)).long()]


def play(policy: Feedback, plan: Plan, split: str) -> Trials:
    """Episodes from starts that are drawn for a purpose."""
    game = policy.game
    x0, theta = draw(game, plan.tests, plan.seed, split, plan.types)
    disturbance = Disturbance(noise=plan.noise, delay=plan.delay, seed=plan.seed)
    parts = zip(x0.split(AT_ONCE), theta.split(AT_ONCE), strict=True)
    hits = [rollout(game, policy, *some, plan.dt, SUBSTEPS, POINTS, disturbance).collided for some in parts]
    return Trials(x0, theta, torch.cat(hits))


def safe_bound(tests: Trials, plan: Plan, solve: Solve) -> SafeBound:
    """The bound over starts whose equilibrium is safe.

    Equilibria are solved from the first tests, which say how many starts are safe, and from all that collide.
    """
    first = len(tests.collided) if plan.equilibria is None else min(plan.equilibria, len(tests.collided))
    asked = tests.collided | (torch.arange(len(tests.collided)) < first)
    found = solve(tests.x0[asked], tests.theta[asked])
    kept, lost = torch.zeros_like(asked), torch.zeros_like(asked)
    kept[asked], lost[asked] = safe(found, plan.clearance), found.status != Status.CONVERGED
    hits, unknown = kept & tests.collided, lost & tests.collided
    bound = conditional_bound(hits, kept, first, plan.beta)
    worst = conditional_bound(hits | unknown, kept | unknown, first, plan.beta)
    return SafeBound(
        plan.clearance,
        first,
        int(kept[:first].sum()),
        int(lost[:first].sum()),
        int(hits.sum()),
        int(unknown.sum()),
        bound,
        max(bound, worst),
    )


def conditional_bound(hits: Tensor, members: Tensor, first: int, beta: float) -> float:
    """Upper bound, with confidence 1 - beta, of the probability of a hit given a member.

    Where members are known of all tests, the exact bound of hits among them. Otherwise of a ratio: P(hit) is bounded
    from all tests and P(member) from the first ones, with beta / 2 each. That they share tests does no harm: one of the
    two is wrong with a probability of beta at most, however they depend on each other.

    Args:
        hits: which tests are hits, all of them members, bool, (N,).
        members: which of the first tests are members, bool, (N,); of the others it need not be known.
        first: how many are the first ones.
        beta: probability with which the bound may be wrong.
    """
    count, known = int(hits.sum()), int(members[:first].sum())
    if first == len(hits):
        return upper_bound(count, known, beta)
    least = lower_bound(known, first, beta / 2)
    return min(1.0, upper_bound(count, len(hits), beta / 2) / least) if least > 0 else 1.0


def region(policy: Feedback, chosen: Trials, tests: Trials, plan: Plan) -> Region | None:
    """The largest region of starts that is found to collide with a probability of at most the target.

    Other starts, `chosen`, fix the margin, its levels and their order, from a small promising region to ever larger
    ones. The tests try them in this order until one fails, each with all of beta (a fixed sequence: the first level
    that is too low passes with a probability of at most beta, and no later one is tried unless it does).

    Returns:
        The last region that passed; None where the first did not.
    """
    found = None
    name, levels = promising(margins(policy, chosen.x0, chosen.theta), chosen.collided, plan)
    margin = margins(policy, tests.x0, tests.theta)[name]
    for level in levels:
        inside = margin >= level
        count, hits = int(inside.sum()), int((inside & tests.collided).sum())
        if upper_bound(hits, count, plan.beta) > plan.target:
            break
        kept = level if math.isfinite(level) else None
        found = Region(name, kept, plan.target, count, hits, count / len(inside))
    return found


def promising(found: Mapping[str, Tensor], collided: Tensor, plan: Plan) -> tuple[str, list[float]]:
    """The margin whose levels promise the largest region, and its levels in the order in which they are tried."""
    orders = {name: _order(margin, collided, plan) for name, margin in found.items()}
    ranked = {name: (reach, ranking(found[name], collided)) for name, (reach, _) in orders.items()}
    best = max(ranked, key=lambda name: ranked[name])
    return best, orders[best][1]


def _order(margin: Tensor, collided: Tensor, plan: Plan) -> tuple[float, list[float]]:
    """The share of starts that levels promise, and the levels from the first one that is to be tried.

    That is the smallest region that would pass with a collision more than it has here: the one that promises most is
    often promising by chance.
    """
    at = torch.tensor([1 - share for share in SHARES], dtype=torch.float64)
    levels = [*margin.double().quantile(at).tolist()[:-1], -math.inf]
    counts = [(int((inside & collided).sum()), int(inside.sum())) for inside in (margin >= one for one in levels)]
    bounds, careful = ([upper_bound(hits + more, count, plan.beta) for hits, count in counts] for more in (0, 1))
    sure = [place for place, bound in enumerate(careful) if bound <= plan.target]
    passing = [share for share, bound in zip(SHARES, bounds, strict=True) if bound <= plan.target]
    return max(passing, default=0.0), levels[sure[0] if sure else bounds.index(min(bounds)) :]


def ranking(margin: Tensor, collided: Tensor) -> float:
    """Probability that a start that collides has a lower margin than one that does not, ties half; 0.5 without both."""
    hit, free = margin[collided].double(), margin[~collided].double().sort().values
    if len(hit) == 0 or len(free) == 0:
        return 0.5
    above = len(free) - torch.searchsorted(free, hit, right=True)
    ties = torch.searchsorted(free, hit, right=True) - torch.searchsorted(free, hit)
    return float((above + ties / 2).double().mean() / len(free))


def margins(policy: Feedback, x0: Tensor, theta: Tensor) -> dict[str, Tensor]:
    """Every margin of starts (N, P, n) of types (N, P), by name, (N,); that of a value that is not finite is lowest."""
    points = Points(torch.full_like(theta[:, 0], policy.game.horizon), x0, theta)
    field = in_batches(policy.operator.field, points)
    least = torch.finfo(theta.dtype).min
    return {name: margin(policy.game, points, field).nan_to_num(least) for name, margin in MARGINS.items()}


def _value(game: Game, points: Points, field: Field | PotentialField) -> Tensor:
    return (field.players if isinstance(field, PotentialField) else field.value).sum(-1)


def _distance(game: Game, points: Points, field: Field | PotentialField) -> Tensor:
    return -game.constraint(points.x, points.theta).amax((-2, -1))


MARGINS: Mapping[str, Callable[[Game, Points, Field | PotentialField], Tensor]] = {
    "value": _value,
    "distance": _distance,
}
"""What a start is worth without playing it: the sum of the learned values, and how far the start itself is from a
collision, which is minus the game's constraint there. Higher is safer."""
