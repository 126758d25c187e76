"""What was labelled while an operator trained, round by round (`hno.training.adaptive`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hno.evaluation import format as text
from hno.evaluation.sections import Column, Section, sections


@sections.register("rounds")
class Rounds(Section):
    """Labels that were added while training."""

    heading = "Labels added while training"
    note = (
        "episodes: from anywhere and along disturbed ones; labelled: starts at which the promised value differs most "
        "from what was got; lost: cost above the equilibrium's at those that are trained on, median"
    )
    columns = (
        Column("step", "step", format=text.whole),
        Column("candidates", "episodes", format=text.whole),
        Column("collided", "collisions", format=text.whole),
        Column("labelled", "labelled", format=text.whole),
        Column("unsolved", "unsolved", format=text.whole),
        Column("inevitable", "inevitable", format=text.whole),
        Column("lost", "lost", format=lambda share: text.percent(share, 1)),
        Column("seconds", "time", "s", format=lambda seconds: text.number(seconds, 0)),
    )

    def rows(self, content: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
        """One line per round."""
        return content
