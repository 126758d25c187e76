"""Sections: registered once, computed and shown from their registration alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from hno.cli.results import Results
from hno.cli.sections import chosen_sections, run_sections, show_section
from hno.control import Feedback
from hno.evaluation.sections import Column, Evaluation, ModelSection, Section, sections
from hno.games import make
from hno.operators import make_operator
from tests.fakes import small_architecture


@pytest.fixture
def horizon() -> Iterator[type[Section]]:
    """A section from outside the package."""

    class Horizon(ModelSection):
        """How long the game is."""

        heading, note = "Length of the game", "a note"
        columns = (Column("types", "types"), Column("seconds", "horizon", "s", lambda seconds: f"{seconds:.1f}"))

        def compute(self, evaluation: Evaluation) -> dict[str, Any]:
            return {"types": len(evaluation.types), "seconds": evaluation.game.horizon}

        def rows(self, content: dict[str, Any]) -> list[dict[str, Any]]:
            return [content]

        def remarks(self, content: dict[str, Any], results: Any) -> list[str]:
            return [f"{results['note']} below"]

    yield sections.register("horizon")(Horizon)
    del sections._classes["horizon"]


@pytest.mark.usefixtures("horizon")
def test_a_section_from_outside_is_computed_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    operator = make_operator(make("narrow_road"), small_architecture())
    types = [(1.0, 1.0), (2.0, 2.0)]
    evaluation = Evaluation("any", Feedback(operator), types, types, {"horizon": True}, lambda condition: [])
    results = Results(tmp_path / "results.json", {})
    assert list(run_sections(evaluation, results)) == [("horizon", {"types": 2, "seconds": 3.0})]
    assert results.content["seconds"]["horizon"] >= 0
    show_section("horizon", {"types": 2, "seconds": 3.0}, {"note": "sentence"}, Console())
    printed = capsys.readouterr().out
    for text in ("Length of the game", "horizon, s", "3.0", "a note", "sentence below"):
        assert text in printed


def test_only_sections_of_one_model_that_are_asked_for_are_computed() -> None:
    assert list(chosen_sections({"online": 0, "ntk": True, "residuals": True, "robustness": False})) == [
        "ntk", "residuals",
    ]  # fmt: skip
    assert chosen_sections({}) == {}
    assert list(chosen_sections({"table": True, "comparison": True})) == []


@pytest.mark.parametrize("name", sections.names())
def test_every_section_says_what_it_is(name: str) -> None:
    section = sections.get(name)
    assert section.heading
    names = [column.name for column in section.columns]
    assert len(set(names)) == len(names) > 0
    assert all(column.heading for column in section.columns)
