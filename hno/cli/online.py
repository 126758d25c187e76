"""The part of an evaluation that solves the game while it is played, beside the learned policy."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from hno.cli.checks import whole_number
from hno.cli.tables import types
from hno.control.receding_horizon import RecedingHorizon
from hno.control.rollout import Disturbance
from hno.evaluation.yardstick import compare, latency, safe_starts
from hno.report.words import interval, number, percent
from hno.training.checkpoint import LearnedPolicy
from hno.types import Extremal

log = logging.getLogger(__name__)

COLUMNS = ("theta", "controller", "starts", "collisions", "rate", "95 % interval", "excess cost", "solves")
NAMES = {"policy": "learned", "solver": "solved online"}


def online_section(policy: LearnedPolicy, labels: Sequence[Extremal], settings: DictConfig) -> dict[str, Any]:
    """Drive `settings.online` safe starts per type with both controllers; JSON content."""
    thetas = [tuple(map(float, found.theta[0])) for found in labels]
    chosen = safe_starts(labels, settings.online, settings.clearance)
    total, every, dt = sum(len(found.status) for found in chosen), settings.online_interval, settings.dt
    section = {"starts_per_type": settings.online, "interval": every, "dt": dt, "table": [], "latency": None}
    if total == 0:
        return section | {"reason": "no start has a safe equilibrium"}
    log.info("Playing %d starts by solving the rest of the game every %g s.", total, every * dt)
    disturbance = Disturbance(settings.noise, settings.delay, settings.seed)
    table = compare(policy.game, policy, chosen, thetas, every, dt, disturbance)
    spent = {
        "policy": latency(policy.game, lambda: policy, chosen, dt=dt),
        "solver": latency(policy.game, lambda: RecedingHorizon(policy.game, every), chosen, every, dt),
    }
    return section | {
        "table": [{name: _plain(value) for name, value in row._asdict().items()} for row in table],
        "latency": {name: part._asdict() | {"rate": part.rate} for name, part in spent.items()},
        "reason": None,
    }


def _plain(value: Any) -> Any:
    return value._asdict() if hasattr(value, "_asdict") else value


def check_online(settings: DictConfig) -> None:
    """Raise ValueError for numbers of starts or steps that are none."""
    for name, least in (("online", 0), ("online_interval", 1)):
        whole_number(name, settings[name], least)


def show_online(section: Mapping[str, Any], console: Console) -> None:
    """Print both controllers' rows and their latencies."""
    if section["latency"] is None:
        console.print(f"Solved online: n/a ({section['reason']}).")
        return
    every = 1000 * section["interval"] * section["dt"]
    caption = "excess cost: above the equilibrium's joint cost, median; solves: in all / searched anew / failed"
    table = Table(*COLUMNS, title=f"The rest of the game solved every {every:g} ms", caption=caption)
    for row in section["table"]:
        for name in NAMES:
            table.add_row(*_cells(row, name), end_section=name == "solver")
    console.print(table)
    for name, spent in section["latency"].items():
        console.print(f"{NAMES[name]}: {_latency(spent)}", soft_wrap=True)


def _cells(row: Mapping[str, Any], name: str) -> list[str]:
    driven, solves = row[name], row["solves"]
    return [
        "all" if row["theta"] is None else types(row["theta"]),
        NAMES[name],
        str(driven["starts"]),
        str(driven["collisions"]) if driven["starts"] else "n/a",
        percent(driven["rate"]),
        interval(driven["interval"]),
        number(driven["median_excess_cost"]),
        f"{solves['solves']} / {solves['searches']} / {solves['failures']}" if name == "solver" else "",
    ]


def _latency(spent: Mapping[str, Any]) -> str:
    played = f"one game on one thread, {spent['answers']} answers in {spent['episodes']} episodes"
    first = f"the first answer takes {_milliseconds(spent['first'])}"
    if spent["median"] is None:
        return f"{first}, and there is no other; {played}"
    middle, slow, busy = (_milliseconds(spent[name]) for name in ("median", "slow", "processor"))
    return f"{spent['rate']:.1f} Hz, {middle} an answer (95 %: {slow}; processor time {busy}); {first}; {played}"


def _milliseconds(seconds: float) -> str:
    return f"{1000 * seconds:.3g} ms"
