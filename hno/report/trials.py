"""The trials of a search, as the page shows them."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import altair as alt

from hno.evaluation.format import NOT_AVAILABLE, counted, percent, significant
from hno.evaluation.sections import Column
from hno.report.strips import heading
from hno.report.study import Study, Trial
from hno.report.tables import Table
from hno.report.vega import Layers, colors

SHOWN = 10
"""Trials of the table, at least as many as are best."""


def said(study: Study) -> str:
    """How trials ended, and what the first objective depends on."""
    states = Counter(trial.state for trial in study.trials)
    ends = ", ".join(f"{count} {state}" for state, count in states.items())
    text = f"{counted(len(study.trials), 'trial')}: {ends}."
    if study.importance:
        shares = ", ".join(f"{name} {percent(share, 0)}" for name, share in study.importance.items())
        shares = shares.replace(" %", "\u00a0%")
        text += f" What the best tenth of trials by {study.objectives[0]} has in common (PED-ANOVA): {shares}."
    return text


def table(study: Study) -> Table:
    """The best trials, then the next ones by the first objective."""
    ordered = sorted(study.finished, key=lambda one: (one.number not in study.best, _values(one)))
    rows = [
        {"trial": one.number, "run": one.job, "mark": "best" if one.number in study.best else ""}
        | dict(zip(study.objectives, _values(one), strict=True))
        | {f"axis {name}": one.params.get(name) for name in study.axes}
        for one in ordered[: max(SHOWN, len(study.best))]
    ]
    columns = [Column("trial", "trial", format=str)]
    columns += [Column(name, name, format=lambda value: significant(value, 4)) for name in study.objectives]
    columns += [Column(f"axis {name}", name, format=_text) for name in study.axes]
    return Table([*columns, Column("run", "run", format=lambda job: job or "elsewhere")], rows)


def points(study: Study) -> dict[str, list[dict[str, Any]]]:
    """Trials by objective, with the best value so far; those without numbers have none."""
    found: dict[str, list[dict[str, Any]]] = {}
    finished = {one.number for one in study.finished}
    for at, name in enumerate(study.objectives):
        least, rows = math.inf, []
        for one in study.trials:
            value = _values(one)[at] if one.number in finished else None
            least = least if value is None else min(least, value)
            so_far = None if least == math.inf else least
            rows.append({"trial": one.number, "value": value, "so_far": so_far, "state": one.state, "tip": _tip(one)}
                        | {"best": one.number in study.best})  # fmt: skip
        found[name] = rows
    return found


def over_trials(data: Any) -> Layers:
    """An objective over trials, from rows of `points`: dots, those of the best trials large, and the best so far.

    Crosses at the bottom are trials without numbers. Its signal "objective" is the name above the vertical axis.
    """
    base = alt.Chart(data).encode(
        x=alt.X(
            "trial:Q", title="trial", axis=alt.Axis(grid=False, tickMinStep=1, format="d"), scale=alt.Scale(nice=False)
        ),
        tooltip="tip:N",
    )
    y = alt.Y("value:Q", title=None, scale=alt.Scale(zero=False), axis=alt.Axis(format=".5~g", tickCount=4, grid=False))
    measured = base.transform_filter("isValid(datum.value)").encode(y=y)
    line = base.transform_filter("isValid(datum.so_far)").mark_line(
        interpolate="step-after", strokeWidth=1.4, color=alt.expr("muted")
    )
    none = base.transform_filter("!isValid(datum.value)").mark_point(
        shape="cross", angle=45, filled=True, size=45, color=alt.expr("datum.state === 'failed' ? danger : muted")
    )
    return (
        alt.layer(
            line.encode(y=alt.Y("so_far:Q", title=None, scale=alt.Scale(zero=False))),
            measured.transform_filter("!datum.best").mark_circle(size=40, opacity=0.7, color=alt.expr("muted")),
            measured.transform_filter("datum.best").mark_circle(size=90, opacity=1, color=alt.expr("ink")),
            none.encode(y=alt.value(alt.expr("height"))),
        )
        .properties(width="container", height=130, title=heading("objective"))
        .add_params(*colors(), alt.param(name="objective", value=""))
    )


def _values(trial: Trial) -> list[float]:
    return trial.values or []


def _text(value: Any) -> str:
    if value is None:
        return NOT_AVAILABLE
    return significant(value, 4) if isinstance(value, float) else str(value)


def _tip(trial: Trial) -> str:
    lines = [
        f"trial {trial.number}, {trial.state}",
        *(f"{name} = {_text(value)}" for name, value in trial.params.items()),
    ]
    return "\n".join([*lines, *([trial.reason] if trial.reason else [])])
