"""The sections of an evaluation that the configuration asks for."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hno.cli.results import Results
from hno.cli.starts import TestLabels
from hno.control.rollout import Disturbance
from hno.evaluation.conditions import ENTRIES, Condition, read_condition
from hno.evaluation.sections import Evaluation, ModelSection, sections
from hno.games import Game
from hno.training.checkpoint import LearnedPolicy


def table_condition(game: Game, settings: Mapping[str, Any]) -> Condition:
    """What the collision table is played under. Raises as `read_condition`."""
    entries = {entry: settings[entry] for entry in ENTRIES if entry in settings}
    return read_condition(game, entries, Condition(disturbance=Disturbance(seed=settings["seed"])))


def evaluation_of(
    name: str, policy: LearnedPolicy, types: Sequence[tuple[float, ...]], settings: Mapping[str, Any], solve: TestLabels
) -> Evaluation:
    """The evaluation of a model as the configuration describes it, before its labels are solved."""
    return Evaluation(
        name=name,
        operator=policy.operator,
        policy=policy,
        seen=policy.types,
        types=types,
        condition=table_condition(policy.game, settings),
        clearance=settings["clearance"],
        dt=settings["dt"],
        options=settings,
        solve=solve,
    )


def chosen_sections(options: Mapping[str, Any]) -> dict[str, ModelSection]:
    """The sections of every model that are asked for, by name; the table is no choice."""
    found = {name: sections.get(name)() for name in sections.names() if name != "table" and options.get(name)}
    return {name: section for name, section in found.items() if isinstance(section, ModelSection)}


def check_sections(evaluation: Evaluation) -> None:
    """Raise ValueError for entries that make no sections."""
    for section in chosen_sections(evaluation.options).values():
        section.check(evaluation)


def run_sections(evaluation: Evaluation, results: Results) -> Iterator[tuple[str, Any]]:
    """Name and content of every section that is asked for, one after the other."""
    for name, section in chosen_sections(evaluation.options).items():
        began = time.perf_counter()
        content = section.compute(evaluation)
        results.time(name, time.perf_counter() - began)
        yield name, content
