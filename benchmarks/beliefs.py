"""What it costs not to know the others' types: `python benchmarks/beliefs.py --checkpoints RUN [RUN ...]`.

Plays two-player games from starts whose equilibrium is safe, the same ones for every arm, at the 25 integer types:
known types, beliefs that never change (worst case, mean of the prior, the far end of the types), and beliefs that are
learned, by both players or by one. With `--pairs N` also N starts of each of the 25 x 25 pairs of true types and wrong
priors.
Prints a table per game and a JSON object as its last line.

    collisions      with the exact 95 % interval (Clopper-Pearson)
    excess          joint cost above that with known types, from the same start, where neither collides: mean and its
                    95 % interval (normal)
    found           share of beliefs whose mean comes within 0.5 of the true type for the rest of the episode, and the
                    median time after which it does, s
    in 90 %         share of beliefs whose smallest set of candidates with 90 % holds the true type, over all times; the
                    interval is a normal one over episodes
    error           distance of the mean from the true type, at first and at last
    types left      exp(entropy) of the last belief: the number of candidates among which it hesitates, median
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

import hno
from hno.control import Feedback, Policy
from hno.control.belief import ACTS, Believing, FixedBelief, Learning
from hno.control.rollout import Disturbance, rollout
from hno.data.certificates import safe
from hno.data.labels import Request, default_cache, safe_labels_for
from hno.evaluation.metrics import clopper_pearson, credible
from hno.types import Trajectory

NEAR = 0.5
"""A mean type is found when it stays within this distance of the true one."""
SURE = 0.99
"""Weight of a wrong prior on one candidate."""


BOTH = 0, 1


class Watched(Policy):
    """A policy beside the beliefs that it had before the first step and after every one.

    Args:
        policy: with beliefs.
        learners: who plays by them; the others know all types.
    """

    def __init__(self, policy: Believing, learners: Sequence[int] = BOTH) -> None:
        self.policy, self.learners, self.past = policy, list(learners), list[Tensor]()
        self.learns = torch.tensor([player in learners for player in BOTH]).unsqueeze(-1)

    def reset(self, x0: Tensor, theta: Tensor) -> None:
        """An episode begins."""
        self.policy.reset(x0, theta)
        self.past = [self.policy.belief.float()]

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Controls, (B, 2, m)."""
        found = self.policy.act(tau, x, theta)
        return (
            found if bool(self.learns.all()) else torch.where(self.learns, found, self.policy.policy.act(tau, x, theta))
        )

    def observe(self, x: Tensor, u: Tensor, dt: float) -> None:
        """What happened."""
        self.policy.observe(x, u, dt)
        self.past.append(self.policy.belief.float())


class Starts(NamedTuple):
    """Where episodes begin, with which types, and what the types are first taken to be where a prior is wrong."""

    x0: Tensor
    theta: Tensor
    believed: Tensor

    def part(self, some: Any) -> Starts:
        """Some of them."""
        return Starts(*(column[some] for column in self))


Arm = Callable[[Starts], Policy]


def fixed(policy: Policy, believed: Callable[[Starts], Tensor]) -> Arm:
    """Players take the others' types to be some (B, 2), whatever they see."""

    def made(starts: Starts) -> Policy:
        own = torch.eye(2, dtype=torch.bool)
        estimates = torch.where(own, starts.theta.unsqueeze(1), believed(starts).unsqueeze(1))
        return FixedBelief(policy, estimates.flatten(0, 1))

    return made


def arms(policy: Feedback, types: int, learning: Learning) -> dict[str, Arm]:
    """What is compared, by name."""
    box = policy.game.type_box
    middle = (box.lo + box.hi) / 2

    def learned(acts: str, learners: Sequence[int] = BOTH, common: bool = False) -> Arm:
        return lambda starts: Watched(Believing(policy, types, acts, learning, common=common), learners)

    return {
        "known types": lambda starts: policy,
        "worst case": fixed(policy, lambda starts: box.hi.expand_as(starts.theta)),
        "mean of the prior": fixed(policy, lambda starts: middle.expand_as(starts.theta)),
        "far end": fixed(policy, lambda starts: torch.where(starts.theta > middle, box.lo, box.hi)),
        **{f"learned: {acts}": learned(acts) for acts in ACTS},
        **{f"learned: {acts}, common": learned(acts, common=True) for acts in ACTS},
        "one learns: mean": learned("mean", (0,)),
        "one learns: mean, common": learned("mean", (0,), common=True),
    }


def integer_types(policy: Feedback) -> Tensor:
    """Five values of either type, (25, 2)."""
    box = policy.game.type_box
    ends = zip(box.lo.tolist(), box.hi.tolist(), strict=True)
    return torch.cartesian_prod(*(torch.linspace(low, high, 5) for low, high in ends))


def safe_starts(policy: Feedback, count: int, seed: int) -> Starts:
    """So many safe starts of each integer type, those of an evaluation with this seed."""
    requests = [Request(tuple(theta), count, seed, "test") for theta in integer_types(policy).tolist()]
    labels, _ = safe_labels_for(policy.game, requests, default_cache(), workers=1)
    chosen = [(found.x[mask, 0].float(), found.theta[mask].float()) for found in labels for mask in [safe(found)]]
    x0, theta = map(torch.cat, zip(*chosen, strict=True))
    return Starts(x0, theta, theta)


class Played(NamedTuple):
    """Episodes without their paths, and the beliefs of those who learn."""

    episodes: Trajectory
    belief: Tensor | None
    """(B, steps + 1, learners, C)."""
    learners: list[int]


def play(policy: Feedback, arm: Arm, starts: Starts, options: argparse.Namespace) -> Played:
    """Play some starts at once, then the next."""
    parts, beliefs, learners = list[Trajectory](), list[Tensor](), list[int]()
    for some in map(Starts, *(part.split(options.at_once) for part in starts)):
        player = arm(some)
        played = rollout(policy.game, player, some.x0, some.theta, disturbance=Disturbance(options.control_noise))
        parts.append(played._replace(x=played.x[:, :0], u=played.u[:, :0]))
        if isinstance(player, Watched):
            learners = player.learners
            beliefs.append(torch.stack(player.past, 1)[:, :, learners])
    columns = zip(*(part[1:] for part in parts), strict=True)
    return Played(Trajectory(parts[0].t, *map(torch.cat, columns)), torch.cat(beliefs) if beliefs else None, learners)


def mean_of(values: Tensor) -> dict[str, float | None]:
    """Mean and half of its normal 95 % interval."""
    if len(values) < 2:
        return {"mean": None, "half_width": None}
    return {"mean": float(values.mean()), "half_width": float(1.96 * values.std() / math.sqrt(len(values)))}


def outcome(played: Trajectory, known: Trajectory) -> dict[str, Any]:
    """Collisions, and cost beside that with known types."""
    count, collisions = len(played.collided), int(played.collided.sum())
    both = ~played.collided & ~known.collided
    return {
        "episodes": count,
        "collisions": collisions,
        "interval": clopper_pearson(collisions, count),
        "excess": mean_of((played.cost - known.cost)[both].double()),
        "known_cost": float(known.cost[both].median()) if bool(both.any()) else None,
    }


def knowledge(played: Played, grid: Tensor, starts: Starts) -> dict[str, Any]:
    """What learners know of the other's type, and how soon."""
    assert played.belief is not None
    t, belief = played.episodes.t, played.belief
    true, candidates = (
        part.flip(place)[..., played.learners, :] for part, place in ((starts.theta.unsqueeze(-1), 1), (grid, 0))
    )
    nearest = (candidates - true).abs().argmin(-1)  # (B, learners)
    error = ((belief * candidates).sum(-1) - true.squeeze(-1).unsqueeze(1)).abs()
    holds = credible(belief).take_along_dim(nearest[:, None, :, None], -1).squeeze(-1).double()
    since = 1 + torch.where(error > NEAR, torch.arange(len(t))[:, None], -1).amax(1)
    found, last = since < len(t), belief[:, -1]
    quarters = [round(share * (len(t) - 1) / 4) for share in range(5)]
    return {
        "found": mean_of(found.double().mean(1)),
        "median_time": float(t[since[found]].median()) if bool(found.any()) else None,
        "coverage": mean_of(holds.mean((1, 2))),
        "coverage_at": {f"{float(t[k]):.2f}": float(holds[:, k].mean()) for k in quarters},
        "error": [float(error[:, k].mean()) for k in (0, -1)],
        "types_left": float(torch.special.entr(last).sum(-1).exp().median()),
    }


def row_of(played: Played, known: Trajectory, grid: Tensor, starts: Starts) -> dict[str, Any]:
    """What came of an arm."""
    found = outcome(played.episodes, known)
    return found if played.belief is None else found | knowledge(played, grid, starts)


def part(played: Trajectory, some: Tensor) -> Trajectory:
    """Some of the episodes."""
    return Trajectory(played.t, *(column[some] for column in played[1:]))


def compared(policy: Feedback, starts: Starts, options: argparse.Namespace) -> Iterator[tuple[str, dict[str, Any]]]:
    """What came of every arm, by name."""
    grid, known = Believing(policy, options.types).grid, None
    for name, arm in arms(policy, options.types, learning_of(options)).items():
        if known is None or not options.only or name in options.only:
            played = play(policy, arm, starts, options)
            known = known or played.episodes
            yield name, row_of(played, known, grid, starts)


def paired(policy: Feedback, starts: Starts, options: argparse.Namespace) -> Iterator[tuple[str, dict[str, Any]]]:
    """What comes of every start with each of the 25 pairs of types as a wrong prior, by how far it is off."""
    grid, priors = Believing(policy, options.types).grid, integer_types(policy)
    row = torch.arange(len(starts.x0)).repeat_interleave(len(priors))
    known = part(play(policy, lambda some: policy, starts, options).episodes, row)
    every = starts.part(row)._replace(believed=priors.repeat(len(starts.x0), 1))

    def learned(some: Starts, common: bool) -> Policy:
        near = (grid - some.believed.unsqueeze(-1)).abs().argmin(-1).flip(-1)
        sure = torch.nn.functional.one_hot(near, options.types).double()
        prior = SURE * sure + (1 - SURE) / options.types
        return Watched(Believing(policy, options.types, "mean", learning_of(options), prior, common))

    off = (every.believed - every.theta).abs().amax(-1).round()
    groups = {"0": off == 0, "1": off == 1, "2": off == 2, "3 or 4": off >= 3, "any": off >= 0}
    chosen: dict[str, Arm] = {
        "kept": fixed(policy, lambda some: some.believed),
        "learned: mean": lambda some: learned(some, common=False),
        "learned: mean, common": lambda some: learned(some, common=True),
    }
    for name, arm in chosen.items():
        if options.only and name not in options.only:
            continue
        played = play(policy, arm, every, options)
        for group, some in groups.items():
            belief = None if played.belief is None else played.belief[some]
            own = Played(part(played.episodes, some), belief, played.learners)
            yield f"{name}, off by {group}", row_of(own, part(known, some), grid, every.part(some))


def learning_of(options: argparse.Namespace) -> Learning:
    """How beliefs follow what is seen."""
    return Learning(options.noise, options.memory, options.floor)


def shown(title: str, rows: Iterator[tuple[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """A table, printed line by line as rows come."""
    names = ("", "collisions", "95 %", "excess", "found", "after, s", "in 90 %", "error", "types left")
    table, found = Table(*names, title=title), dict[str, dict[str, Any]]()
    for name, row in rows:
        found[name] = row
        low, high = row["interval"]
        cells = [
            name,
            f"{row['collisions']} of {row['episodes']}",
            f"{100 * low:.2f} to {100 * high:.2f} %",
            _mean(row["excess"]),
        ]
        if "found" in row:
            first, last = row["error"]
            when = "never" if row["median_time"] is None else f"{row['median_time']:.2f}"
            cells += [
                _mean(row["found"], 100),
                when,
                _mean(row["coverage"], 100),
                f"{first:.2f} to {last:.2f}",
                f"{row['types_left']:.1f}",
            ]
        table.add_row(*cells)
        print(json.dumps({"game": title, "arm": name, **row}), flush=True)
    Console(width=150).print(table)
    return found


def _mean(entry: dict[str, float | None], scale: float = 1) -> str:
    if entry["mean"] is None or entry["half_width"] is None:
        return "n/a"
    return (
        f"{scale * entry['mean']:.{1 if scale > 1 else 2}f} +- {scale * entry['half_width']:.{1 if scale > 1 else 2}f}"
    )


def main() -> None:
    """Print the tables and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkpoints", nargs="+", required=True, help="runs or checkpoints of two-player games")
    parser.add_argument("--starts", type=int, default=8, help="safe starts of each of the 25 types")
    parser.add_argument("--pairs", type=int, default=0, help="of these, starts that are played with all 25 priors")
    parser.add_argument("--types", type=int, default=9, help="candidates of a belief")
    parser.add_argument("--noise", type=float, default=Learning().noise)
    parser.add_argument("--memory", type=float, default=Learning().memory)
    parser.add_argument("--floor", type=float, default=Learning().floor)
    parser.add_argument("--control-noise", type=float, default=0.0, help="of what is played, in half widths of the box")
    parser.add_argument("--only", nargs="+", default=[], help="arms beside the known types")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--at-once", type=int, default=500, help="episodes")
    options = parser.parse_args()
    torch.set_num_threads(1)
    everything: dict[str, Any] = {"options": vars(options)}
    for checkpoint in options.checkpoints:
        policy = hno.load_policy(checkpoint)
        if policy.game.players != 2:
            parser.error(f"{checkpoint} has {policy.game.players} players; this compares games of two.")
        game, starts = type(policy.game).__name__, safe_starts(policy, options.starts, options.seed)
        everything[game] = {"arms": shown(game, compared(policy, starts, options))}
        if options.pairs:
            first = [
                k
                for theta in integer_types(policy)
                for k in (starts.theta == theta).all(-1).nonzero()[: options.pairs, 0]
            ]
            some = starts.part(torch.stack(first))
            everything[game]["pairs"] = shown(f"{game}, true types x priors", paired(policy, some, options))
    print(json.dumps(everything))


if __name__ == "__main__":
    main()
