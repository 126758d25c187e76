"""One HTML file about a sweep, which asks no network; what it shows of single runs of several lies beside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup

from hno.data.store import replace_whole
from hno.evaluation import format as text
from hno.evaluation.sections import plain
from hno.report import clearances, landscapes, page_data, trials, vega, verdicts
from hno.report.charts import specifications
from hno.report.parts import Beside, Keep, parts
from hno.report.recipes import Recipe, best, headline, recipes
from hno.report.records import Run
from hno.report.runs import Sweep
from hno.report.tables import (
    CACHED,
    FILTERS,
    Table,
    label_tables,
    mapping_table,
    names_of,
    recipe_table,
    run_table,
    section_tables,
)
from hno.report.validity import validity


def write_page(sweep: Sweep, path: Path, refresh: float | None = None) -> None:
    """Write the page, whole or not at all, and what it loads of several runs; of one run all is in the page.

    Args:
        sweep: what it is about.
        path: where it lies; scripts are in the folder `<its name>_files` beside it.
        refresh: in how many seconds an open page loads itself again.
    """
    beside = Beside(path)
    page = render(sweep, refresh, path.parent, beside.keep if len(sweep.runs) > 1 else None)
    replace_whole(path, lambda draft: draft.write_text(page, encoding="utf-8"))
    beside.tidy()


def render(sweep: Sweep, refresh: float | None = None, place: Path | None = None, keep: Keep | None = None) -> str:
    """The page as text.

    Args:
        sweep: what it is about.
        refresh: see `write_page`.
        place: the folder that it will lie in.
        keep: keeps what belongs to a single run elsewhere and returns the address; without it, all is in the page.
    """
    runs, found = sweep.runs, recipes(sweep.runs)
    cards, chosen = _cards(found, runs), best(found)
    listed, kept, total = parts(runs, keep or (lambda part: part))
    data = _data(sweep, found, cards, place) | {"parts": kept, "episodes": listed, "refresh": refresh}
    common, differing = _settings(runs, found)
    sections = [(run, section_tables(run)) for run in runs]
    games = {game: [one for one in chosen if one.game == game] for game in sorted({one.game for one in found})}
    return _template().render(
        sweep=sweep, recipes=found, single=len(runs) == 1,
        games={game: (headline(own), own) for game, own in games.items()}, cards=cards,
        unfinished=[run for run in runs if not run.finished and (len(runs) == 1 or run.status != "pruned")],
        filters={name: _choices(runs, name) for name in FILTERS},
        curve_games=sorted({one["game"] for one in data["curves"]}),
        near_games=sorted({one["game"] for one in data["clearances"]}), recipe_table=recipe_table(found),
        run_table=run_table(runs), labels=label_tables(runs), sections=[entry for entry in sections if entry[1]],
        common=common, differing=differing, cached=CACHED, shown=len(listed), total=total,
        landscapes=data["landscapes"], refresh=refresh, themes=vega.THEMES, font=Markup(vega.FONT),
        vega=Markup(vega.library().replace("</script", "<\\/script").replace("<!--", "<\\!--")), data=embedded(data),
    )  # fmt: skip


def _data(sweep: Sweep, found: Sequence[Recipe], cards: Sequence[dict[str, Any]], place: Path | None) -> dict[str, Any]:
    """What the page's scripts draw from, but for single runs."""
    runs = sweep.runs
    return {
        "maps": {card["id"]: page_data.heat_map(card["recipe"].types) for card in cards if "run" not in card},
        "comparison": page_data.comparison(found),
        "clearances": clearances.curves(found),
        "curves": page_data.learning_curves(found, runs),
        "runs": [{**names_of(run), "run": run.name} for run in runs],
        "scenes": page_data.scenes(runs),
        "members": {card["id"]: [run.name for run in card["recipe"].runs] for card in cards},
        "landscapes": landscapes.entries(runs, place),
        "trials": trials.points(sweep.study) if sweep.study else {},
        "charts": {**specifications(), "landscape": landscapes.chart()},
        "themes": {name: {"config": vega.chart_config(name), "signals": vega.signals(name)} for name in vega.THEMES},
    }


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("hno.report", "assets"), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.globals |= {"format": text, "verdicts": verdicts, "names_of": names_of}
    environment.globals |= {"validity": validity, "trials": trials}
    return environment.get_template("page.html.j2")


def embedded(content: Any) -> Markup:
    """JSON that no text inside can leave: nothing in it looks like markup."""
    return htmlsafe_json_dumps(content, separators=(",", ":"), sort_keys=True, allow_nan=False)


def _cards(found: Sequence[Recipe], runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Heat maps of recipes, safest first, then of their single runs."""
    ordered = sorted((one for one in found if one.types), key=lambda one: (one.game, one.pooled.rate or 0.0))
    pooled = [{"recipe": one, "names": names_of(one) | {"level": "recipe"}, "runs": one.seeds} for one in ordered]
    places = {id(run): k for k, run in enumerate(runs)}
    single = [
        {
            "recipe": dataclasses.replace(one, runs=(run,)),
            "names": names_of(run) | {"level": "run"},
            "run": places[id(run)],
        }
        | {"runs": f"seed {plain(run.seed)}"}
        for one in ordered
        for run in one.runs
        if run.table
    ]
    return [{**card, "id": f"map{k}"} for k, card in enumerate([*pooled, *single])]


def _choices(runs: Sequence[Run], name: str) -> list[str]:
    values = {getattr(run, name) for run in runs}
    return [plain(value) for value in sorted(values, key=lambda value: (value is None, value or 0))]


def _settings(runs: Sequence[Run], found: Sequence[Recipe]) -> tuple[dict[str, str | None], Table]:
    """Settings and versions that all runs share, and a table of the others by recipe."""
    said = {run.name: {**run.settings, **{f"version of {p}": v for p, v in run.versions.items()}} for run in runs}
    keys = dict.fromkeys(key for one in said.values() for key in one)
    values = {key: {one.get(key) for one in said.values()} for key in keys}
    differing = [key for key, some in values.items() if len(some) > 1 and key != "seed"]
    rows = [
        {"game": one.game, "recipe": one.name, **{key: said[one.runs[0].name].get(key) for key in differing}}
        for one in found
        if one.runs and differing
    ]
    return {key: next(iter(some)) for key, some in values.items() if len(some) == 1}, mapping_table(rows)
