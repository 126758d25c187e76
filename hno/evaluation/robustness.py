"""How safe a policy is when something is not as it was made for."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from hno.control.rollout import Player
from hno.data.labels import interchangeable
from hno.evaluation import format as text
from hno.evaluation.closed_loop import play
from hno.evaluation.conditions import Condition, read_conditions
from hno.evaluation.outcome import outcome, pooled, together
from hno.evaluation.sections import COUNTS, Column, Evaluation, ModelSection, sections
from hno.games import Game
from hno.types import Extremal

log = logging.getLogger(__name__)


def robustness_row(
    game: Game, policy: Player, condition: Condition, labels: Sequence[Extremal], clearance: float, dt: float
) -> dict[str, Any]:
    """What comes of a policy from the starts of labels under a condition.

    Args:
        game: the game.
        policy: feedback controls of all players.
        condition: of the episodes.
        labels: where episodes begin and what their equilibria cost, one set per type.
        clearance: what the label must keep for its start to count, in the unit of the game's constraint.
        dt: time for which a control is held, s.

    Returns:
        The condition, the `Outcome` of all types together, and "types": safe starts and collisions of each.
    """
    played = play(game, policy, labels, dt, condition.disturbance)
    by_type = [outcome(game, *sets, clearance) for sets in zip(labels, played, strict=True)]
    types = [
        {"theta": tuple(found.theta[0].tolist()), "safe_starts": one.safe_starts, "collisions": one.collisions}
        for found, one in zip(labels, by_type, strict=True)
    ]
    whole = outcome(game, *together(labels, played), clearance)
    return {"name": condition.name, "condition": condition.entries(), **whole._asdict(), "types": types}


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
        """One line per condition; that of symmetric starts is left out where players differ in their roles."""
        game, rows = evaluation.game, []
        for condition in conditions_of(evaluation):
            if condition.symmetric and not interchangeable(game):
                log.info("Condition %s is left out: the players of this game are not interchangeable.", condition.name)
                continue
            settings = evaluation.solve(condition), evaluation.clearance, evaluation.dt
            rows.append(robustness_row(game, evaluation.policy, condition, *settings))
        return rows

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
    theta = pooled(rows).worst_theta
    if theta is None:
        return "none" if any(row["safe_starts"] for row in rows) else None
    worst = next(row for row in rows if tuple(row["theta"]) == theta)
    return f"{worst['collisions']} of {worst['safe_starts']} at ({text.types(theta)})"
