"""Sections of an evaluation: what is computed for each, and the columns that terminal and page show of it.

A section is one registered class, which a package from outside may add by the entry-point group `hno.sections`. Its
name is its entry in results.json and the configuration entry that asks for it.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

from hno.control import Feedback
from hno.data.states import equilibria_from
from hno.evaluation import format as text
from hno.evaluation.conditions import Condition, table_condition
from hno.evaluation.outcome import Played
from hno.games import Game
from hno.registry import Registry
from hno.types import Extremal

sections: Registry[Section] = Registry("section", "hno.evaluation", base="hno.evaluation.sections:Section")
Type = tuple[float, ...]
"""Types of all players."""


def plain(value: Any) -> str:
    """Any value as text; "n/a" for None."""
    return text.NOT_AVAILABLE if value is None else str(value)


class Column(NamedTuple):
    """A column of a section's table."""

    name: str
    """Entry of a row that it shows."""
    heading: str
    unit: str = ""
    """Of its numbers; empty where they have none, or their text names it."""
    format: Callable[[Any], str] = plain
    """The text of an entry."""

    @property
    def title(self) -> str:
        """Heading and unit."""
        return f"{self.heading}, {self.unit}" if self.unit else self.heading


COUNTS = (
    Column("safe_starts", "safe starts", format=text.whole),
    Column("collisions", "collisions", format=text.whole),
    Column("rate", "rate", format=text.percent),
    Column("interval", "95 % interval", format=text.interval),
)
"""Columns of an `hno.evaluation.outcome.Outcome`."""


class Evaluation(NamedTuple):
    """One model and how it is evaluated."""

    name: str
    """Path of its checkpoint."""
    policy: Feedback
    """Its feedback controls of all players, and its value function."""
    seen: Sequence[Type]
    """Types that it was trained with."""
    types: Sequence[Type]
    """Types that are evaluated."""
    options: Mapping[str, Any]
    """Entries of the configuration."""
    solve: Callable[[Condition], Sequence[Extremal]]
    """Labels of the starts of a condition, one set per type."""
    labels: Sequence[Extremal] = ()
    """Labels of the starts, one set per type; empty before they are solved."""
    played: Sequence[Played] = ()
    """What came of the episodes from these starts, one set per type."""
    equilibria: Callable[..., Extremal] = equilibria_from
    """As `hno.data.states.equilibria_from`, with the cache, the processes and the report of the command."""

    @property
    def game(self) -> Game:
        """The game."""
        return self.policy.game

    @property
    def clearance(self) -> float:
        """What a label must keep for its start to count, in the unit of the game's constraint."""
        return float(self.options["clearance"])

    @property
    def dt(self) -> float:
        """Time for which a control is held, s."""
        return float(self.options["dt"])

    @property
    def condition(self) -> Condition:
        """Of the starts and the episodes."""
        return table_condition(self.game, self.options)


class Section(abc.ABC):
    """A part of results.json that is shown as a table with remarks below it."""

    heading: ClassVar[str]
    """Above the table."""
    note: ClassVar[str] = ""
    """What the columns mean, where their headings do not say it."""
    columns: ClassVar[tuple[Column, ...]]

    @abc.abstractmethod
    def rows(self, content: Any) -> Sequence[Mapping[str, Any]]:
        """Lines of the table, each with an entry for every column, from the section's content of results.json."""

    def remarks(self, content: Any, results: Mapping[str, Any]) -> list[str]:
        """Sentences below the table; `results` has the other entries of results.json, such as `clearance`."""
        return []


class ModelSection(Section):
    """A section that is computed for every model."""

    def check(self, evaluation: Evaluation) -> None:
        """Refuse what cannot be computed, before any label is solved.

        Raises:
            ValueError: entries of the configuration, or the model, make no such section.
        """

    @abc.abstractmethod
    def compute(self, evaluation: Evaluation) -> Any:
        """The section's content of results.json."""
