"""One self-contained HTML file about a sweep: no network, no other file."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
from markupsafe import Markup

from hno.data.store import replace_whole
from hno.evaluation.format import interval, percent
from hno.evaluation.outcome import Pooled
from hno.evaluation.sections import plain
from hno.report import episodes, page_data, vega, verdicts
from hno.report.charts import specifications
from hno.report.palette import DARK, LIGHT, chart_config, signals, variables
from hno.report.recipes import Recipe, TypeCounts, by_type, headline, pool, recipes
from hno.report.records import Run
from hno.report.runs import Sweep
from hno.report.tables import (
    CACHED,
    Table,
    label_tables,
    mapping_table,
    names_of,
    recipe_table,
    run_table,
    section_tables,
    type_table,
)

ASSETS = files("hno.report") / "assets"
SCRIPTS = ("base.js", "filters.js", "charts.js", "player.js", "refresh.js")


def write_page(sweep: Sweep, path: Path, refresh: float | None = None) -> None:
    """Write the page, whole or not at all.

    Args:
        sweep: the runs.
        path: the file.
        refresh: seconds after which an open page loads itself again; None for never.
    """
    text = render(sweep, refresh)
    replace_whole(path, lambda draft: draft.write_text(text, encoding="utf-8"))


def render(sweep: Sweep, refresh: float | None = None) -> str:
    """The page as text."""
    found = recipes(sweep.runs)
    cards = _cards(sweep.runs, found)
    played = episodes.ranked(sweep.runs)
    curves = page_data.learning_curves(found, sweep.runs)
    themes = {"light": LIGHT, "dark": DARK}
    data = {
        "maps": {card.id: page_data.cells(card.types) for card in cards},
        "comparison": page_data.comparison(found),
        "curves": curves,
        "episodes": [episodes.playable(run, one) for run, one in played[: episodes.MOST]],
        "charts": specifications(),
        "themes": {name: {"config": chart_config(p), "signals": signals(p)} for name, p in themes.items()},
        "refresh": refresh,
    }
    unfinished = [run for run in sweep.runs if not run.finished]
    sections = [(run.name, names_of(run, "any"), section_tables(run)) for run in sweep.runs]
    content = {
        "sweep": sweep, "recipes": found, "games": _games(found), "cards": cards, "unfinished": unfinished,
        "remarks": sum(len(run.notes) for run in sweep.runs) + sum(len(recipe.repeated) for recipe in found),
        "filters": {name: _choices(sweep.runs, name) for name in ("game", "operator", "activation", "seed")},
        "compared_games": sorted({recipe.game for recipe in found if recipe.pooled.safe_starts}),
        "curve_games": sorted({entry["game"] for entry in curves}),
        "recipe_table": recipe_table(found), "run_table": run_table(sweep.runs), "labels": label_tables(sweep.runs),
        "sections": [entry for entry in sections if entry[2]], "common": _common(sweep.runs),
        "differing": _differing(sweep.runs, found), "versions": _versions(sweep.runs), "cached": CACHED,
        "episodes_shown": min(len(played), episodes.MOST), "episodes_total": len(played), "refresh": refresh,
        "variables": {name: Markup(variables(palette)) for name, palette in themes.items()},
        "style": Markup(_asset("page.css")), "vega": Markup(_script(vega.library())),
        "script": Markup(_script("\n".join(_asset(name) for name in SCRIPTS))), "data": embedded(data),
        "jobs": verdicts.jobs, "why": verdicts.why, "seeds": verdicts.seeds, "at": verdicts.at,
        "share": verdicts.share, "quality": verdicts.quality, "interval": interval, "percent": percent,
    }  # fmt: skip
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(_asset("page.html.j2")).render(**content)


def embedded(content: Any) -> Markup:
    """JSON that no text inside can leave: nothing in it looks like markup."""
    text = json.dumps(content, separators=(",", ":"), sort_keys=True, allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def _script(text: str) -> str:
    """A script that may stand in a page: it leaves no names behind, and nothing in it ends the element."""
    closed = text.replace("</script", "<\\/script").replace("<!--", "<\\!--")
    return f"(() => {{\n{closed}\n}})();"


class Game(NamedTuple):
    """One card of the summary."""

    name: str
    best: Recipe | None
    """None where nothing was played."""
    sentences: list[str]
    """About the best recipe of every kind of conditions."""


def _games(found: Sequence[Recipe]) -> list[Game]:
    judged = [(recipe.game, recipe, text) for recipe, text in verdicts.verdicts(found)]
    chosen = {game: [recipe for own, recipe, _ in judged if own == game] for game in sorted({r.game for r in found})}
    return [
        Game(game, headline(own) if own else None, [text for name, _, text in judged if name == game])
        for game, own in chosen.items()
    ]


class Card(NamedTuple):
    """A heat map with its numbers, of a recipe over its seeds or of a single run."""

    id: str
    names: dict[str, str]
    """What it is filtered by."""
    title: str
    runs: str
    """What it is made of."""
    types: Sequence[TypeCounts]
    pooled: Pooled
    numbers: Table


def _cards(runs: Sequence[Run], found: Sequence[Recipe]) -> list[Card]:
    """Recipes, safest first, then single runs."""
    ordered = sorted((one for one in found if one.types), key=lambda one: (one.game, one.pooled.rate or 0.0))
    names = {run.name: recipe.name for recipe in found for run in recipe.runs}
    recipe_cards = [
        Card(f"r{k}", names_of(one, "recipe"), one.name, verdicts.seeds(one), one.types, one.pooled,
             type_table(one.types))
        for k, one in enumerate(ordered)
    ]  # fmt: skip
    tables = [(run, by_type(run.table)) for run in runs if run.table]
    return recipe_cards + [
        Card(f"s{k}", names_of(run, "run"), names.get(run.name, run.operator), f"seed {run.seed}", types,
             pool(run.table), type_table(types))
        for k, (run, types) in enumerate(tables)
    ]  # fmt: skip


def _choices(runs: Sequence[Run], name: str) -> list[str]:
    values = {getattr(run, name) for run in runs}
    return [plain(value) for value in sorted(values, key=lambda value: (value is None, 0 if value is None else value))]


def _values(runs: Sequence[Run]) -> dict[str, set[str | None]]:
    """What runs say of each setting."""
    return {
        key: {run.settings.get(key) for run in runs} for key in dict.fromkeys(k for run in runs for k in run.settings)
    }


def _common(runs: Sequence[Run]) -> dict[str, str | None]:
    """Settings that all runs share."""
    return {key: next(iter(values)) for key, values in _values(runs).items() if len(values) == 1}


def _differing(runs: Sequence[Run], found: Sequence[Recipe]) -> Table | None:
    """The other settings by recipe."""
    keys = [key for key, values in _values(runs).items() if len(values) > 1 and key != "seed"]
    shown = [(recipe, recipe.runs[0].settings) for recipe in found if recipe.runs]
    rows = [
        {"game": recipe.game, "recipe": recipe.name, **{key: settings.get(key) for key in keys}}
        for recipe, settings in shown
    ]
    return mapping_table(rows) if keys and rows else None


def _versions(runs: Sequence[Run]) -> list[tuple[str, str]]:
    """Packages and the versions that runs had."""
    found: dict[str, Counter[str]] = {}
    for run in runs:
        for package, version in run.versions.items():
            found.setdefault(package, Counter())[version] += 1
    return [
        (package, next(iter(n)) if len(n) == 1 else ", ".join(f"{v} ({k} runs)" for v, k in sorted(n.items())))
        for package, n in found.items()
    ]
