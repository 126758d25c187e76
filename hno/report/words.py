"""Numbers and verdicts for people."""

from __future__ import annotations

from collections.abc import Sequence

from hno.report.aggregate import Rate, Recipe, Spread, best, rivals, worst
from hno.report.parsing import TypeResult
from hno.report.runs import NOT_AVAILABLE, Run, Sweep


def number(value: float | None, digits: int = 2) -> str:
    """A number with a few decimals; "n/a" when there is none."""
    return NOT_AVAILABLE if value is None else f"{value:,.{digits}f}"


def percent(value: float | None, digits: int = 2) -> str:
    """A share; "n/a" when there is none, "< 0.01 %" rather than a rounded zero."""
    if value is None:
        return NOT_AVAILABLE
    least = 10.0**-digits
    return f"< {least:.{digits}f} %" if 0 < 100 * value < least / 2 else f"{100 * value:.{digits}f} %"


def signed(value: float | None) -> str:
    """A relative difference."""
    return NOT_AVAILABLE if value is None else f"{100 * value:+,.1f} %"


def interval(bounds: tuple[float, float] | None) -> str:
    """Both bounds of a share."""
    return NOT_AVAILABLE if bounds is None else f"{100 * bounds[0]:.2f} to {100 * bounds[1]:.2f} %"


def theta(types: Sequence[float]) -> str:
    """Player types."""
    return f"({', '.join(f'{entry:g}' for entry in types)})"


def counted(count: int, noun: str) -> str:
    """A number of things."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def rate(found: Rate) -> str:
    """Collisions of starts, with everything needed to judge them."""
    if not found.starts:
        return f"no safe start, collision rate {NOT_AVAILABLE}"
    return (
        f"{counted(found.collisions, 'collision')} in {counted(found.starts, 'safe start')} "
        f"({percent(found.value)}, 95 % interval {interval(found.interval)})"
    )


def share(found: Rate) -> str:
    """Collisions of starts, in short."""
    return f"{found.collisions:,} of {found.starts:,}: {percent(found.value)}"


def worst_type(found: TypeResult | None) -> str:
    """The type with the highest rate: "none" where nothing collided, "n/a" without starts."""
    if found is None:
        return NOT_AVAILABLE
    return f"{theta(found.theta)} {percent(found.collisions / found.starts)}" if found.collisions else "none"


def clearance(value: float | None) -> str:
    """How close an episode came."""
    if value is None:
        return f"clearance {NOT_AVAILABLE}"
    return f"{abs(value):.2f} m {'short of' if value > 0 else 'inside'} the collision radius"


def over_seeds(found: Spread | None) -> str:
    """Mean with its t interval, or that there is one seed only."""
    if found is None:
        return NOT_AVAILABLE
    if found.interval is None:
        return f"{signed(found.mean)} (one seed)"
    low, high = found.interval
    return f"{signed(found.mean)} ({signed(low)} to {signed(high)}, {found.seeds} seeds)"


def seeds(recipe: Recipe) -> str:
    """How many seeds count."""
    return counted(len(recipe.runs), "seed")


def jobs(sweep: Sweep) -> str:
    """How many jobs ended how."""
    finished = sum(run.finished for run in sweep.runs)
    failed = sum(run.status == "failed" for run in sweep.runs)
    parts = [f"{finished} finished"]
    parts += [f"{failed} failed"] if failed else []
    open_jobs = len(sweep.runs) - finished - failed
    parts += [f"{open_jobs} unfinished"] if open_jobs else []
    waiting = (sweep.planned or 0) - len(sweep.runs) - len(sweep.skipped)
    parts += [f"{waiting} not begun"] if waiting > 0 else []
    parts += [f"{counted(len(sweep.skipped), 'folder')} skipped"] if sweep.skipped else []
    return f"{counted(len(sweep.runs), 'run')}: {', '.join(parts)}."


def quality(found: Rate) -> str:
    """One word of judgement: "safe" (nothing collided), "rare" (at most 1 %), "unsafe" or "unknown"."""
    if found.value is None:
        return "unknown"
    return "safe" if found.collisions == 0 else ("rare" if found.value <= 0.01 else "unsafe")


def verdicts(recipes: Sequence[Recipe]) -> list[tuple[str, Recipe, str]]:
    """Game, its best recipe and a judgement of it, for every game and conditions of play."""
    return [(one.game, one, _verdict(one, recipes)) for one in best(recipes).values()]


def _verdict(recipe: Recipe, recipes: Sequence[Recipe]) -> str:
    judged = {"safe": "No start collides", "rare": "Collisions are rare", "unsafe": "Not safe"}[quality(recipe.rate)]
    most = worst(recipe.table)
    at = ""
    if recipe.rate.collisions and most is not None:
        at = f" Worst type {theta(most.theta)}: {most.collisions} of {most.starts:,}."
    others = [other.name for other in rivals(recipe, recipes)]
    rest = f" Not told apart from {_list(others)}: the intervals overlap." if others else ""
    return (
        f"{judged} ({seeds(recipe)}, {recipe.conditions}): 95 % interval {interval(recipe.rate.interval)}.{at} "
        f"Joint cost above the equilibrium's: {over_seeds(recipe.excess)}.{rest}"
    )


def _list(names: Sequence[str], shown: int = 3) -> str:
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(names[:shown]) + more


def why(run: Run) -> str:
    """Why a run has no result."""
    if run.status == "failed":
        return run.reason or "failed without a reason"
    return f"unfinished: its results say {run.status!r}. It is still at work, or was killed."
