"""How safe a policy is when something is not as it was made for."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from hno.control.rollout import Player
from hno.data.labels import interchangeable
from hno.evaluation import format as text
from hno.evaluation.closed_loop import play
from hno.evaluation.conditions import Condition, read_conditions
from hno.evaluation.outcome import Outcome, outcome, pooled, together
from hno.evaluation.sections import Column, Evaluation, ModelSection, sections
from hno.games import Game
from hno.types import Extremal

log = logging.getLogger(__name__)


class ConditionRow(NamedTuple):
    """One line of the robustness table."""

    condition: Condition
    """Of the episodes."""
    outcome: Outcome
    """Of all types together."""
    types: list[dict[str, Any]]
    """Safe starts and collisions of each type."""

    def content(self) -> dict[str, Any]:
        """All entries with those of the outcome beside them, for results.json."""
        condition = {"name": self.condition.name, "condition": self.condition.entries()}
        return {**condition, **self.outcome._asdict(), "types": self.types}


LabelsOf = Callable[[Condition], Sequence[Extremal]]
"""Labels of the starts of a condition, one set per type."""


def robustness_table(
    game: Game, policy: Player, conditions: Sequence[Condition], labels_of: LabelsOf, clearance: float, dt: float
) -> list[ConditionRow]:
    """Play from the starts of labels under every condition.

    Args:
        game: the game.
        policy: feedback controls of all players.
        conditions: the lines of the table.
        labels_of: where episodes begin and what their equilibria cost.
        clearance: what the label must keep for its start to count, in the unit of the game's constraint.
        dt: time for which a control is held, s.
    """
    return [_row(game, policy, condition, labels_of(condition), clearance, dt) for condition in conditions]


def _row(
    game: Game, policy: Player, condition: Condition, labels: Sequence[Extremal], clearance: float, dt: float
) -> ConditionRow:
    played = play(game, policy, labels, dt, condition.disturbance)
    by_type = [outcome(game, *sets, clearance) for sets in zip(labels, played, strict=True)]
    types = [
        {"theta": tuple(found.theta[0].tolist()), "safe_starts": one.safe_starts, "collisions": one.collisions}
        for found, one in zip(labels, by_type, strict=True)
    ]
    return ConditionRow(condition, outcome(game, *together(labels, played), clearance), types)


@sections.register("robustness")
class Robustness(ModelSection):
    """Collisions under every condition."""

    heading = "Robustness"
    note = "excess cost: above the undisturbed equilibrium's joint cost, median"
    columns = (
        Column("name", "condition"),
        Column("safe_starts", "safe starts", format=text.whole),
        Column("collisions", "collisions", format=text.whole),
        Column("rate", "rate", format=text.percent),
        Column("interval", "95 % interval", format=text.interval),
        Column("worst", "worst type"),
        Column("excess", "excess cost", format=text.cost),
    )

    def check(self, evaluation: Evaluation) -> None:
        """Raises as `read_conditions`."""
        conditions_of(evaluation)

    def compute(self, evaluation: Evaluation) -> list[dict[str, Any]]:
        """One line per condition; that of symmetric starts is left out where players differ in their roles."""
        game, chosen = evaluation.game, list[Condition]()
        for condition in conditions_of(evaluation):
            if condition.symmetric and not interchangeable(game):
                log.info("Condition %s is left out: the players of this game are not interchangeable.", condition.name)
            else:
                chosen.append(condition)
        rows = robustness_table(game, evaluation.policy, chosen, evaluation.solve, evaluation.clearance, evaluation.dt)
        return [row.content() for row in rows]

    def rows(self, content: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """One line per condition."""
        return [
            {**row, "worst": _worst(row["types"]), "excess": (row["median_excess_cost"], row["median_label_cost"])}
            for row in content
        ]


def conditions_of(evaluation: Evaluation) -> list[Condition]:
    """What the robustness table plays under. Raises as `read_conditions`."""
    return read_conditions(evaluation.game, evaluation.options["conditions"], evaluation.condition)


def _worst(rows: Sequence[Mapping[str, Any]]) -> str | None:
    """The type of the highest rate; None where no start counts."""
    whole = pooled(rows)
    if whole.rate is None or whole.worst_theta is None:
        return None if whole.rate is None else "none"
    worst = next(row for row in rows if tuple(row["theta"]) == whole.worst_theta)
    return f"{worst['collisions']} of {worst['safe_starts']} at ({text.types(whole.worst_theta)})"
