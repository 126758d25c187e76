"""Two policies on the same starts: how much more often one of them collides."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from scipy.optimize import brentq
from scipy.stats import binomtest, norm
from torch import Tensor

from hno.data.certificates import safe
from hno.evaluation import format as text
from hno.evaluation.sections import Column, Evaluation, Section, sections
from hno.games import Game


class Comparison(NamedTuple):
    """A policy against a reference, start by start; numbers that do not exist are None."""

    starts: int
    """Pairs of episodes: safe starts of all types."""
    both: int
    """Starts from which both collide."""
    only_reference: int
    """Starts from which only the reference collides."""
    only_other: int
    """Starts from which only the other one collides."""
    difference: float | None
    """Collision rate of the other one minus that of the reference."""
    interval: tuple[float, float] | None
    """Tango's 95 % score interval of the difference."""
    p_value: float | None
    """Exact McNemar test of equal rates, two-sided."""


class DifferentGamesError(ValueError):
    """Models whose starts cannot be paired."""


def check_same_game(names: Sequence[str], games: Sequence[Game]) -> None:
    """Refuse to compare models, by these names, of different games.

    Raises:
        DifferentGamesError: the games differ, by class or by constants.
    """
    constants = [", ".join(f"{name}={value}" for name, value in game.constants.items()) for game in games]
    pairs = zip(names, games, constants, strict=True)
    first, *others = [f"{name} plays {type(game).__name__}({values})" for name, game, values in pairs]
    for game, other in zip(games[1:], others, strict=True):
        if game.fingerprint() != games[0].fingerprint():
            raise DifferentGamesError(
                f"Models of different games have no starts in common: {first}, {other}. Evaluate them one by one."
            )


def compare(reference: Tensor, other: Tensor) -> Comparison:
    """Compare two policies by whether each collides from the same starts, (B,)."""
    n = len(reference)
    both, first, second = (int(c.sum()) for c in (reference & other, reference & ~other, other & ~reference))
    if n == 0:
        return Comparison(0, 0, 0, 0, None, None, None)
    return Comparison(n, both, first, second, (second - first) / n, tango(first, second, n), mcnemar(first, second))


def mcnemar(first: int, second: int) -> float:
    """p-value of equal rates, from the numbers of discordant pairs; 1 without any.

    Given how many pairs are discordant, either kind is equally likely (McNemar 1947, in its exact, two-sided form).
    """
    return float(binomtest(first, first + second).pvalue) if first + second else 1.0


def tango(first: int, second: int, pairs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Score interval of the difference of two paired proportions, second minus first (Tango, Stat. Med. 17, 1998).

    It holds the differences that a score test does not reject, so that it holds 0 exactly where McNemar's asymptotic
    test does not reject equal rates, and it has a width without discordant pairs too. In `first` of the `pairs`, at
    least 1, only the first event happens, in `second` only the second one.
    """
    z = float(norm.ppf((1 + confidence) / 2))
    return -_upper(second, first, pairs, z), _upper(first, second, pairs, z)


def _upper(b: int, c: int, n: int, z: float) -> float:
    """The difference above (c - b) / n whose score is -z."""
    estimate = (c - b) / n

    def excess(delta: float) -> float:
        """Squared score minus z^2, times the variance, which vanishes at the ends."""
        half = (b + c + (c - b) * delta - 2 * n * delta) / 2
        only_first = (half + math.sqrt(max(0.0, half**2 + 2 * n * b * delta * (1 - delta)))) / (2 * n)
        return (c - b - n * delta) ** 2 - z**2 * n * (2 * only_first + delta * (1 - delta))

    return float(brentq(excess, estimate + 1e-12, 1.0, xtol=1e-12))


@sections.register("comparison")
class PairedComparison(Section):
    """Every model against the first, on the same starts."""

    heading = "Models against the first of them, from the same starts"
    note = "interval: Tango's score interval of the paired difference; p: exact McNemar test of equal rates"
    columns = (
        Column("model", "model"),
        Column("starts", "starts", format=text.whole),
        Column("both", "both", format=text.whole),
        Column("only_reference", "only first", format=text.whole),
        Column("only_other", "only this", format=text.whole),
        Column("difference", "difference of rates", format=text.percent),
        Column("interval", "95 % interval", format=text.interval),
        Column("p_value", "p", format=lambda p: text.significant(p, 2)),
    )

    def compute(self, evaluations: Sequence[Evaluation]) -> dict[str, Any]:
        """Every model against the first, over all types and type by type."""
        reference, *others = evaluations
        first, rows = _collisions(reference), []
        for other in others:
            second = _collisions(other)
            pairs = zip(other.types, first, second, strict=True)
            by_type = [{"theta": theta, **compare(*pair)._asdict()} for theta, *pair in pairs]
            whole = compare(torch.cat(first), torch.cat(second))
            rows.append({"checkpoint": other.name, **whole._asdict(), "types": by_type})
        return {"reference": reference.name, "models": rows}

    def rows(self, content: Mapping[str, Any]) -> list[dict[str, Any]]:
        """One line per model but the first."""
        _, *names = _names(content)
        return [{**row, "model": name} for name, row in zip(names, content["models"], strict=True)]

    def remarks(self, content: Mapping[str, Any], results: Mapping[str, Any]) -> list[str]:
        """Which model is the first."""
        return [f"All models are compared against {_names(content)[0]}."]


def _names(content: Mapping[str, Any]) -> list[str]:
    return text.short_names([content["reference"], *(row["checkpoint"] for row in content["models"])])


def _collisions(evaluation: Evaluation) -> list[Tensor]:
    """Whether the model collides, safe start by safe start, one (safe starts,) per type."""
    return [played.collided[safe(played.label, evaluation.clearance)] for played in evaluation.played]
