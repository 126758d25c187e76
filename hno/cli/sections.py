"""Parts of an evaluation beside the collision table: what computes each, and what prints it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from hno.cli.build import cache_folder
from hno.cli.checks import flag
from hno.cli.ntk import check_ntk, ntk_section, ntk_table
from hno.cli.online import check_online, online_section, show_online
from hno.cli.results import Results
from hno.cli.starts import solve_starts
from hno.cli.tables import show_residuals, show_robustness
from hno.control.rollout import Disturbance
from hno.evaluation.residuals import residual_table
from hno.evaluation.robustness import Condition, read_conditions, robustness_table
from hno.games import Game
from hno.training.checkpoint import LearnedPolicy
from hno.types import Extremal

Types = Sequence[tuple[float, ...]]


class Section(NamedTuple):
    """A part of an evaluation, switched on by the configuration entry of its name."""

    compute: Callable[[LearnedPolicy, Sequence[Extremal], DictConfig], Any]
    """(policy, labels of every type, configuration) -> content of results.json."""
    show: Callable[[Any, Console], None]
    """Prints that content."""
    check: Callable[[LearnedPolicy, Types, DictConfig], object] = lambda policy, types, settings: None
    """Raises ValueError for entries that make no sense, before anything expensive."""


def residuals(policy: LearnedPolicy, labels: Sequence[Extremal], settings: DictConfig) -> list[dict[str, Any]]:
    """The HJI residual by type, region and time to go."""
    return [row._asdict() for row in residual_table(policy.operator, labels, policy.types, seed=settings.seed)]


def robustness(policy: LearnedPolicy, labels: Sequence[Extremal], settings: DictConfig) -> list[dict[str, Any]]:
    """Collisions under every condition."""
    game, types = policy.game, [tuple(found.theta[0].tolist()) for found in labels]

    def labels_of(widen: float) -> Sequence[Extremal]:
        if widen == settings.widen:
            return labels
        return solve_starts(game, types, settings, cache_folder(settings.cache), settings.workers, widen)[0]

    rows = robustness_table(game, policy, conditions(game, settings), labels_of, settings.clearance, settings.dt)
    return [row._asdict() for row in rows]


def conditions(game: Game, settings: DictConfig) -> list[Condition]:
    """What the robustness table plays under. Raises as `read_conditions`."""
    base = Condition("", float(settings.widen), Disturbance(settings.noise, settings.delay, settings.seed))
    return read_conditions(game, OmegaConf.to_object(settings.conditions), base)


SECTIONS: dict[str, Section] = {
    "residuals": Section(residuals, show_residuals),
    "robustness": Section(
        robustness, show_robustness, lambda policy, types, settings: conditions(policy.game, settings)
    ),
    "ntk": Section(
        ntk_section,
        lambda section, console: console.print(ntk_table(section)),
        check_ntk,
    ),
    "online": Section(online_section, show_online),
}


def check_sections(policy: LearnedPolicy, types: Types, settings: DictConfig) -> None:
    """Raise ValueError for entries that make no sections."""
    for name in ("residuals", "robustness", "ntk"):
        flag(name, settings[name])
    check_online(settings)
    for name, section in SECTIONS.items():
        if settings[name]:
            section.check(policy, types, settings)


def run_sections(
    policy: LearnedPolicy, labels: Sequence[Extremal], settings: DictConfig, results: Results
) -> Iterator[tuple[str, Any]]:
    """Name and content of every section that is switched on, one after the other."""
    for name, section in SECTIONS.items():
        if settings[name]:
            began = time.perf_counter()
            content = section.compute(policy, labels, settings)
            results.time(name, time.perf_counter() - began)
            yield name, content
