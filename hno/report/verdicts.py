"""Judgements and other sentences of a report."""

from __future__ import annotations

from collections.abc import Sequence

from hno.evaluation.format import NOT_AVAILABLE, at, counted, interval, percent, signed
from hno.evaluation.outcome import Pooled
from hno.report.episode import Episode
from hno.report.recipes import Recipe, Spread, rivals
from hno.report.records import Run
from hno.report.runs import Sweep


def share(found: Pooled) -> str:
    """Collisions of starts, in short."""
    return f"{found.collisions:,} of {found.safe_starts:,}: {percent(found.rate)}"


def clearance(found: Episode, unit: str) -> str:
    """How close an episode came; for distances, to the collision radius."""
    if found.clearance is None:
        return f"clearance {NOT_AVAILABLE}"
    if found.radius is None:
        return f"clearance {found.clearance:.2f} {unit}".strip()
    return f"{abs(found.clearance):.2f} m {'short of' if found.clearance > 0 else 'inside'} the collision radius"


def over_seeds(found: Spread | None) -> str:
    """Mean with its interval, or that there is one seed only."""
    if found is None:
        return NOT_AVAILABLE
    if found.interval is None:
        return f"{signed(found.mean)} (one seed)"
    low, high = found.interval
    return f"{signed(found.mean)} ({signed(low)} to {signed(high)}, {found.seeds} seeds)"


def jobs(sweep: Sweep) -> str:
    """How many jobs ended how."""
    finished = sum(run.finished for run in sweep.runs)
    failed = sum(run.status == "failed" for run in sweep.runs)
    counts = {"failed": failed, "unfinished": len(sweep.runs) - finished - failed}
    said = [f"{finished} finished", *(f"{count} {state}" for state, count in counts.items() if count > 0)]
    said += [f"{counted(len(sweep.skipped), 'folder')} skipped"] if sweep.skipped else []
    return f"{counted(len(sweep.runs), 'run')}: {', '.join(said)}."


def quality(found: Pooled) -> str:
    """One word of judgement: "safe" (nothing collided), "rare" (at most 1 %), "unsafe" or "unknown"."""
    if found.rate is None:
        return "unknown"
    return "safe" if found.collisions == 0 else ("rare" if found.rate <= 0.01 else "unsafe")


def verdict(recipe: Recipe, recipes: Sequence[Recipe]) -> str:
    """A judgement of a recipe in which something was played, and the others that it is not told apart from."""
    whole = recipe.pooled
    judged = {"safe": "No start collides", "rare": "Collisions are rare", "unsafe": "Not safe"}[quality(whole)]
    worst = next((one for one in recipe.types if one["theta"] == whole.worst_theta), None)
    told = f" Worst type {at(worst['theta'])}: {worst['collisions']} of {worst['safe_starts']:,}." if worst else ""
    others = [other.name for other in rivals(recipe, recipes)]
    names = ", ".join(others[:3]) + (f" and {len(others) - 3} more" if len(others) > 3 else "")
    rest = f" Not told apart from {names}: the intervals overlap." if others else ""
    return (
        f"{judged} ({recipe.seeds}, {recipe.conditions}): 95 % interval {interval(whole.interval)}.{told} "
        f"Joint cost above the equilibrium's: {over_seeds(recipe.excess)}.{rest}"
    )


def why(run: Run) -> str:
    """Why a run has no result."""
    if run.status == "running":
        return "unfinished: it is still at work."
    return f"{'' if run.status == 'failed' else f'{run.status}: '}{run.reason or 'it does not say why'}"
