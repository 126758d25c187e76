"""How safe a policy is when something is not as it was made for."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from hno.data.labels import interchangeable
from hno.data.ties import TIE, TooFewTiesError
from hno.evaluation import format as text
from hno.evaluation.closed_loop import play
from hno.evaluation.conditions import TIES, Condition, read_conditions
from hno.evaluation.outcome import numbers_of, outcomes, pooled
from hno.evaluation.sections import COUNTS, Column, Evaluation, ModelSection, sections

MEANING = {
    "symmetric": "all players start in the same own state",
    "ties": f"the two cheapest equilibria of every start cost the same within {100 * TIE:g} %; at most {TIES} per type",
}
"""What entries of a condition mean whose name does not say it."""
log = logging.getLogger(__name__)


@sections.register("robustness")
class Robustness(ModelSection):
    """Collisions under every condition."""

    heading = "Robustness"
    note = "excess cost: above the undisturbed equilibrium's joint cost, median"
    columns = (
        Column("name", "condition"),
        *COUNTS,
        Column("worst", "worst type"),
        Column("excess", "excess cost", format=text.cost),
    )

    def check(self, evaluation: Evaluation) -> None:
        """Raises as `read_conditions`."""
        conditions_of(evaluation)

    def compute(self, evaluation: Evaluation) -> list[dict[str, Any]]:
        """The condition, the `Outcome` of all types together and counts by type, one line per condition.

        Symmetric starts are left out where players differ in their roles.
        """
        game, rows = evaluation.game, []
        for condition in conditions_of(evaluation):
            if condition.symmetric and not interchangeable(game):
                log.info("Condition %s is left out: the players of this game are not interchangeable.", condition.name)
                continue
            try:
                labels = evaluation.solve(condition)
            except TooFewTiesError as error:
                log.warning("Condition %s is left out: %s", condition.name, error)
                continue
            played = play(game, evaluation.policy, labels, evaluation.dt, condition.disturbance)
            by_type, whole = outcomes([numbers_of(game, *one) for one in played], evaluation.clearance)
            types = [
                {"theta": theta, "safe_starts": one.safe_starts, "collisions": one.collisions}
                for theta, one in zip(evaluation.types, by_type, strict=True)
            ]
            names = {"name": condition.name, "condition": condition.entries()}
            rows.append({**names, **whole._asdict(), "types": types})
        return rows

    def rows(self, content: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """One line per condition."""
        return [
            {**row, "worst": _worst(row["types"]), "excess": (row["median_excess_cost"], row["median_label_cost"])}
            for row in content
        ]

    def remarks(self, content: Sequence[Mapping[str, Any]], results: Mapping[str, Any]) -> list[str]:
        """What start states of a condition are where it is not the box alone."""
        entries = ((row, entry) for row in content for entry in MEANING if row["condition"].get(entry))
        return [f"Condition {row['name']}: {MEANING[entry]}." for row, entry in entries]


def conditions_of(evaluation: Evaluation) -> list[Condition]:
    """What the robustness table plays under. Raises as `read_conditions`."""
    return read_conditions(evaluation.game, evaluation.options["conditions"], evaluation.condition)


def _worst(rows: Sequence[Mapping[str, Any]]) -> str | None:
    """The type of the highest rate; None where no start counts."""
    theta = pooled(rows).worst_theta
    if theta is None:
        return "none" if any(row["safe_starts"] for row in rows) else None
    worst = next(row for row in rows if tuple(row["theta"]) == theta)
    return f"{worst['collisions']} of {worst['safe_starts']} at {text.at(theta)}"
