"""How safe a policy is when something is not as it was made for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch

from hno.control.disturbance import pushed_states
from hno.control.rollout import Disturbance, Player
from hno.evaluation.closed_loop import classify, collided, excess_costs, median, play
from hno.evaluation.metrics import clopper_pearson
from hno.games import Game
from hno.registry import unknown_name
from hno.types import Extremal


class Condition(NamedTuple):
    """What is different in one line of the table."""

    name: str
    """Of the line."""
    widen: float = 1.0
    """Width of the start box in units of the game's."""
    disturbance: Disturbance = Disturbance()
    """Of the episodes."""


class ConditionRow(NamedTuple):
    """One line of the robustness table, over all types; numbers that do not exist or are not finite are None."""

    name: str
    """Of the condition."""
    widen: float
    """Width of the start box in units of the game's."""
    disturbance: dict[str, Any]
    """What differs from an undisturbed episode, by the names of `Disturbance`."""
    safe_starts: int
    """Starts that count."""
    collisions: int
    """Collisions among those."""
    rate: float | None
    """Collisions per safe start."""
    interval: tuple[float, float] | None
    """Clopper-Pearson 95 % interval of the rate."""
    median_excess_cost: float | None
    """Median over safe starts of the joint cost above the undisturbed equilibrium's."""
    median_label_cost: float | None
    """Median over safe starts of the equilibrium's joint cost."""
    types: list[dict[str, Any]]
    """Safe starts and collisions of each type."""


LabelsOf = Callable[[float], Sequence[Extremal]]
"""Labels of the starts of a start box so many times as wide, one set per type."""


def read_conditions(game: Game, content: object, base: Condition) -> list[Condition]:
    """Conditions from a configuration: name -> entries that replace those of the base.

    Raises:
        ValueError: no conditions, an entry that does not exist, or a number that makes no sense.
    """
    if not (isinstance(content, Mapping) and content):
        raise ValueError(f"conditions must be names with entries such as {{noise: {{noise: 0.2}}}}; got {content!r}.")
    conditions = []
    for name, entries in content.items():
        if not isinstance(entries, Mapping):
            raise ValueError(f"conditions.{name} must be entries such as {{noise: 0.2}}; got {entries!r}.")
        for entry, value in entries.items():
            _check(f"conditions.{name}.{entry}", entry, value)
        chosen = entries.get("components")
        pushed_states(game, chosen)
        known = {**entries, "components": None if chosen is None else tuple(chosen)}
        widen = float(known.pop("widen", base.widen))
        conditions.append(Condition(str(name), widen, base.disturbance._replace(**known)))
    return conditions


ENTRIES = ("widen", "noise", "delay", "drift", "gusts", "components", "belief")


def _check(place: str, entry: str, value: object) -> None:
    if entry not in ENTRIES:
        raise ValueError(f"{place} does not exist. {unknown_name('condition entry', entry, list(ENTRIES))}")
    if entry == "components":
        valid = value is None or (isinstance(value, list) and all(type(place) is int for place in value))
        wanted = "a list of places in a player's state, or null"
    elif entry == "delay":
        valid, wanted = type(value) is int and value >= 0, "a whole number of at least 0"
    else:
        least = 0.0 if entry != "widen" else math.nextafter(0.0, 1.0)
        valid = type(value) in (int, float) and least <= value < math.inf  # type: ignore[operator]  # a number
        wanted = "a finite number of at least 0" if entry != "widen" else "a positive number"
    if not valid:
        raise ValueError(f"{place} must be {wanted}; got {value!r}.")


def robustness_table(
    game: Game, policy: Player, conditions: Sequence[Condition], labels_of: LabelsOf, clearance: float, dt: float
) -> list[ConditionRow]:
    """Play the starts of labels under every condition.

    Args:
        game: the game.
        policy: feedback controls of all players.
        conditions: the lines of the table.
        labels_of: where episodes begin and what their equilibria cost.
        clearance: what the label must keep for its start to count, m for distance constraints.
        dt: time for which a control is held, s.
    """
    return [_row(game, policy, condition, labels_of(condition.widen), clearance, dt) for condition in conditions]


def _row(
    game: Game, policy: Player, condition: Condition, labels: Sequence[Extremal], clearance: float, dt: float
) -> ConditionRow:
    types, excess, costs = list[dict[str, Any]](), [], []
    for found, played in zip(labels, play(game, policy, labels, dt, condition.disturbance), strict=True):
        safe, _ = classify(found, clearance)
        excess.append(excess_costs(found, played).sum(-1)[safe])
        costs.append(-found.value[:, 0].sum(-1)[safe])
        counts = {"safe_starts": int(safe.sum()), "collisions": int((collided(played) & safe).sum())}
        types.append({"theta": tuple(found.theta[0].tolist()), **counts})
    collisions, counted = (sum(row[name] for row in types) for name in ("collisions", "safe_starts"))
    undisturbed = Disturbance(seed=condition.disturbance.seed)._asdict()
    return ConditionRow(
        name=condition.name,
        widen=condition.widen,
        disturbance={key: value for key, value in condition.disturbance._asdict().items() if value != undisturbed[key]},
        safe_starts=counted,
        collisions=collisions,
        rate=collisions / counted if counted else None,
        interval=clopper_pearson(collisions, counted),
        median_excess_cost=median(torch.cat(excess)),
        median_label_cost=median(torch.cat(costs)),
        types=types,
    )
