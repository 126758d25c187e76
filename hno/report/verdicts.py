"""Judgements and other sentences of a report."""

from __future__ import annotations

from collections.abc import Sequence

from hno.evaluation.format import NOT_AVAILABLE, at, counted, interval, percent, signed
from hno.evaluation.outcome import Pooled
from hno.report.episode import Episode
from hno.report.recipes import Recipe, Rival, Spread, rivals
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
    counts = {status: sum(run.status == status for run in sweep.runs) for status in ("failed", "pruned")}
    counts["unfinished"] = len(sweep.runs) - finished - sum(counts.values())
    said = [f"{finished} finished", *(f"{count} {state}" for state, count in counts.items() if count > 0)]
    said += [f"{counted(len(sweep.skipped), 'folder')} skipped"] if sweep.skipped else []
    return f"{counted(len(sweep.runs), 'run')}: {', '.join(said)}."


def quality(found: Pooled) -> str:
    """One word of judgement: "safe" (nothing collided), "rare" (at most 1 %), "unsafe" or "unknown"."""
    if found.rate is None:
        return "unknown"
    return "safe" if found.collisions == 0 else ("rare" if found.rate <= 0.01 else "unsafe")


LEFT_OUT = {
    "inevitable": "whose equilibrium collides",
    "marginal": "whose equilibrium passes closer than the clearance",
    "unsolved": "without a converged equilibrium",
}
"""Why a start does not count, by the entry of the table that counts them."""


def denominator(recipe: Recipe) -> str:
    """How many of the starts count that were played, and why the others do not."""
    rows = [row for run in recipe.runs for row in run.table]
    starts, safe = (sum(row[name] for row in rows) for name in ("starts", "safe_starts"))
    each = f" ({recipe.seeds} from the same starts)" if len(recipe.runs) > 1 else ""
    left = [(sum(row[name] for row in rows), why) for name, why in LEFT_OUT.items()]
    said = [f"{count:,} {why}" for count, why in left if count]
    rest = starts - safe - sum(count for count, _ in left)
    said += [f"{rest:,} for reasons that the table does not name"] if rest > 0 else []
    chosen = {run.settings.get("evaluation.safe", run.settings.get("safe")) for run in recipe.runs} == {"true"}
    drawn = " They were drawn until so many were safe; those that were not are not in the table." if chosen else ""
    if starts == safe:
        return f"All {starts:,} starts count{each}.{drawn}"
    return f"{safe:,} of {starts:,} starts count{each}; left out: {', '.join(said)}.{drawn}"


def verdict(recipe: Recipe, recipes: Sequence[Recipe]) -> str:
    """A judgement of a recipe in which something was played, and the others that it is not told apart from."""
    whole = recipe.pooled
    judged = {"safe": "No start collides", "rare": "Collisions are rare", "unsafe": "Not safe"}[quality(whole)]
    worst = next((one for one in recipe.types if one["theta"] == whole.worst_theta), None)
    told = f" Worst type {at(worst['theta'])}: {worst['collisions']:,} of {worst['safe_starts']:,}." if worst else ""
    return (
        f"{judged} ({recipe.seeds}, {recipe.conditions}): 95 % interval {interval(whole.interval)}.{told} "
        f"Joint cost above the equilibrium's: {over_seeds(recipe.excess)}.{told_apart(rivals(recipe, recipes))}"
    )


def told_apart(found: Sequence[Rival]) -> str:
    """From which other recipes the chosen one is told apart, and by which test; nothing without others."""
    if not found:
        return ""
    same = [one for one in found if not one.told_apart]
    names = ", ".join(_named(one) for one in same[:3]) + (f" and {len(same) - 3} more" if len(same) > 3 else "")
    tested = any(one.p_value is not None for one in found)
    by = ["exact sign test of the same starts (one seed: McNemar's), p after Holm, level 5 %"] if tested else []
    by += ["no outcome of single starts was kept, so no paired test: whether the intervals overlap"] * any(
        one.p_value is None for one in found
    )
    apart = f" Told apart from {len(found) - len(same)} of {counted(len(found), 'other recipe')}"
    return f"{apart}{'; not from ' + names if same else ''} ({'; '.join(by)})."


def _named(one: Rival) -> str:
    return one.recipe.name + ("" if one.p_value is None else f" (p = {one.p_value:.2g})")


def why(run: Run) -> str:
    """Why a run has no result."""
    if run.status == "running":
        return "unfinished: it is still at work."
    return f"{'' if run.status == 'failed' else f'{run.status}: '}{run.reason or 'it does not say why'}"
