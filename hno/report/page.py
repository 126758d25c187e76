"""One self-contained HTML file about a sweep: no network, no other file."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from hno.data.store import replace_whole
from hno.evaluation.format import NOT_AVAILABLE, interval, percent
from hno.evaluation.outcome import Pooled
from hno.evaluation.sections import plain
from hno.report import episodes, page_data, vega, verdicts
from hno.report.charts import specifications
from hno.report.palette import DARK, LIGHT, chart_config, signals, variables
from hno.report.recipes import Recipe, TypeCounts, best, by_type, headline, pool, recipes
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
        "maps": {card["id"]: page_data.cells(card["types"]) for card in cards},
        "comparison": page_data.comparison(found),
        "curves": curves,
        "episodes": [episodes.playable(run, one) for run, one in played[: episodes.MOST]],
        "charts": specifications(),
        "themes": {name: {"config": chart_config(p), "signals": signals(p)} for name, p in themes.items()},
        "refresh": refresh,
    }
    content = {
        **_results(sweep, found),
        **_origin(sweep, found),
        "cards": cards,
        "curve_games": sorted({entry["game"] for entry in curves}),
        "episodes_shown": min(len(played), episodes.MOST),
        "episodes_total": len(played),
        "refresh": refresh,
        "variables": {name: Markup(variables(palette)) for name, palette in themes.items()},
        "style": Markup(_asset("page.css")),
        "vega": Markup(_script(vega.library())),
        "script": Markup(_script("\n".join(_asset(name) for name in SCRIPTS))),
        "data": embedded(data),
    }
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


def _results(sweep: Sweep, found: Sequence[Recipe]) -> dict[str, Any]:
    """What came of the runs, and which of them say nothing."""
    runs = sweep.runs
    sections = [(run.name, names_of(run, "any"), section_tables(run)) for run in runs]
    return {
        "name": sweep.name,
        "jobs": verdicts.jobs(sweep),
        "games": _games(found),
        "filters": {name: _choices(runs, name) for name in ("game", "operator", "activation", "seed")},
        "cached": CACHED,
        "recipe_table": recipe_table(found),
        "run_table": run_table(runs),
        "problems": [(run.name, run.status, verdicts.why(run)) for run in runs if not run.finished],
        "skipped": sweep.skipped,
        "notes": [(run.name, note) for run in runs for note in run.notes],
        "repeated": [run.name for recipe in found for run in recipe.repeated],
        "compared_games": sorted({recipe.game for recipe in found if recipe.pooled.safe_starts}),
        "sections": [entry for entry in sections if entry[2]],
        "labels": label_tables(runs),
    }


def _origin(sweep: Sweep, found: Sequence[Recipe]) -> dict[str, Any]:
    """Settings, versions and command lines."""
    common, differing = _settings(sweep.runs, found)
    return {
        "common": common,
        "differing": differing,
        "versions": _versions(sweep.runs),
        "command": sweep.command,
        "commands": [(run.name, run.command or f"{NOT_AVAILABLE}: no .hydra/overrides.yaml") for run in sweep.runs],
    }


def _games(found: Sequence[Recipe]) -> list[dict[str, Any]]:
    """One card of the summary for every game."""
    judged = verdicts.verdicts(found)
    chosen: dict[str, list[Recipe]] = {recipe.game: [] for recipe in sorted(found, key=lambda one: one.game)}
    for recipe in best(found).values():
        chosen[recipe.game].append(recipe)
    return [
        _game(game, candidates, [text for one, text in judged if one.game == game])
        for game, candidates in chosen.items()
    ]


def _game(game: str, chosen: Sequence[Recipe], sentences: list[str]) -> dict[str, Any]:
    if not chosen:
        text = f"Nothing was played: the collision rate is {NOT_AVAILABLE}."
        return {"name": game, "quality": "unknown", "rate": NOT_AVAILABLE, "best": "", "n": "", "sentences": [text]}
    first = headline(chosen)
    whole = first.pooled
    counts = f"{whole.collisions:,} of {whole.safe_starts:,}"
    return {
        "name": game, "quality": verdicts.quality(whole), "rate": percent(whole.rate),
        "best": f"{first.name} ({first.conditions})", "n": counts, "sentences": sentences,
    }  # fmt: skip


def _cards(runs: Sequence[Run], found: Sequence[Recipe]) -> list[dict[str, Any]]:
    """Heat maps of recipes over their seeds, safest first, then those of single runs."""
    ordered = sorted((one for one in found if one.types), key=lambda one: (one.game, one.pooled.rate or 0.0))
    names = {run.name: recipe.name for recipe in found for run in recipe.runs}
    pooled = [
        _card(f"r{k}", one, one.name, verdicts.seeds(one), one.types, one.pooled) for k, one in enumerate(ordered)
    ]
    single = [
        _card(f"s{k}", run, names.get(run.name, run.operator), f"seed {run.seed}", by_type(run.table), pool(run.table))
        for k, run in enumerate(runs)
        if run.table
    ]
    return [*pooled, *single]


def _card(
    identifier: str, of: Run | Recipe, title: str, counted: str, types: Sequence[TypeCounts], whole: Pooled
) -> dict[str, Any]:
    worst = "" if whole.worst_theta is None else f", worst {verdicts.at(whole.worst_theta)}"
    return {
        "id": identifier, "names": names_of(of, "run" if isinstance(of, Run) else "recipe"), "title": title,
        "quality": verdicts.quality(whole), "text": verdicts.share(whole),
        "sub": f"{interval(whole.interval)}, {counted}{worst}", "types": types, "numbers": type_table(types),
        "map": len(types[0].theta) == 2,
    }  # fmt: skip


def _choices(runs: Sequence[Run], name: str) -> list[str]:
    values = {getattr(run, name) for run in runs}
    return [plain(value) for value in sorted(values, key=lambda value: (value is None, value or 0))]


def _settings(runs: Sequence[Run], found: Sequence[Recipe]) -> tuple[dict[str, str], Table | None]:
    """Settings that all runs share, and a table of the others by recipe."""
    keys = list(dict.fromkeys(key for run in runs for key in run.settings))
    values = {key: {run.settings.get(key) for run in runs} for key in keys}
    common = {key: str(next(iter(values[key]))) for key in keys if len(values[key]) == 1}
    rest = [key for key in keys if len(values[key]) > 1 and key != "seed"]
    rows = [
        {"game": one.game, "recipe": one.name, **{key: one.runs[0].settings.get(key) for key in rest}}
        for one in found
        if one.runs
    ]
    return common, mapping_table(rows) if rest and rows else None


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
