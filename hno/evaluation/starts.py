"""What came of single starts, kept with the results: models that played the same ones are compared start by start."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from scipy.stats import binomtest
from torch import Tensor

from hno.data.certificates import safe
from hno.evaluation.sections import Evaluation, Type

OUTCOMES = "outcomes.json"
"""Name of their file inside a run's folder."""


class Starts(NamedTuple):
    """What came of the starts of one type, in their order."""

    theta: Type
    key: str
    """Equal for equal start states in equal order."""
    counted: str
    """One digit per start: 1 where it counts, since its equilibrium keeps the clearance."""
    collided: str
    """One digit per start: 1 where the episode collides."""
    clearance: tuple[float | None, ...] = ()
    """Smallest clearance of every episode, in the constraint's unit; None where it is lost; empty if none was kept."""
    label_clearance: tuple[float | None, ...] = ()
    """The same of the equilibrium."""


def key_of(x0: Tensor) -> str:
    """A name for start states: equal for equal ones."""
    return hashlib.sha256(x0.detach().double().cpu().numpy().round(6).tobytes()).hexdigest()[:16]


def starts_of(evaluation: Evaluation) -> list[dict[str, Any]]:
    """JSON content of the file: a `Starts` for every type of an evaluation with labels and episodes."""
    return [
        Starts(
            tuple(found.theta[0].tolist()), key_of(found.x[:, 0]), _digits(safe(found, evaluation.clearance)),
            _digits(played.collided), _numbers(played.clearance), _numbers(found.clearance),
        )._asdict()
        for found, played in zip(evaluation.labels, evaluation.played, strict=True)
    ]  # fmt: skip


def starts_from(content: Any) -> Starts:
    """The record of an entry of the file.

    Raises:
        ValueError: it is none.
    """
    try:
        key, counted, collided = (str(content[name]) for name in ("key", "counted", "collided"))
        near = (tuple(map(_number, content.get(name, ()))) for name in ("clearance", "label_clearance"))
        found = Starts(tuple(map(float, content["theta"])), key, counted, collided, *near)
    except (LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"expected {', '.join(Starts._fields)}; got {content!r:.60}") from error
    if {len(found.clearance), len(found.label_clearance)} - {0, len(found.counted)}:
        raise ValueError(f"clearances must be one per start; got {content!r:.60}")
    if len(found.counted) != len(found.collided) or set(found.counted + found.collided) - {"0", "1"}:
        raise ValueError(f"counted and collided must be digits 0 and 1, one per start; got {content!r:.60}")
    return found


class Paired(NamedTuple):
    """Two recipes on the starts that both played."""

    starts: int
    """Starts that count."""
    better: int
    """Starts from which the first collides in a smaller share of its runs."""
    worse: int
    """Starts from which it collides in a larger share."""
    p_value: float
    """Two-sided exact sign test of equal shares; for one run each it is McNemar's exact test."""


def paired(first: Sequence[Mapping[Type, Starts]], second: Sequence[Mapping[Type, Starts]]) -> Paired | None:
    """Compare the runs of two recipes start by start; None if they did not all play the same starts.

    Runs of a recipe, such as its seeds, share starts, so that a start is the unit and not an episode.
    """
    runs = [*first, *second]
    if not first or not second or not all(runs) or len({tuple(sorted(run)) for run in runs}) > 1:
        return None
    if any(run[theta][1:3] != runs[0][theta][1:3] for run in runs for theta in run):
        return None
    differences = list[int]()
    for theta, one in runs[0].items():
        for k in (k for k, digit in enumerate(one.counted) if digit == "1"):
            shares = (sum(run[theta].collided[k] == "1" for run in some) for some in (first, second))
            own, other = shares
            differences.append(own * len(second) - other * len(first))
    better, worse = (sum(sign * one > 0 for one in differences) for sign in (-1, 1))
    p_value = float(binomtest(better, better + worse).pvalue) if better + worse else 1.0
    return Paired(len(differences), better, worse, p_value)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's p-values, adjusted for their number, in the given order."""
    adjusted, largest = dict[int, float](), 0.0
    for place, k in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        largest = max(largest, min(1.0, (len(p_values) - place) * p_values[k]))
        adjusted[k] = largest
    return [adjusted[k] for k in range(len(p_values))]


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _numbers(values: Tensor) -> tuple[float | None, ...]:
    """With four significant digits, which keep the sign."""
    return tuple(float(f"{one:.4g}") if math.isfinite(one) else None for one in values.double().tolist())


def _digits(flags: Tensor) -> str:
    return "".join("01"[flag] for flag in flags.long().tolist())
