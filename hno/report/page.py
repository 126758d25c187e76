"""One self-contained HTML file about a sweep: no network, no other file, at most 3 MB."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from hno.data.store import replace_whole
from hno.report import payload, words
from hno.report.aggregate import Recipe, best, headline, total, worst
from hno.report.charts import library, specifications
from hno.report.further import fitting, further
from hno.report.grouping import recipes
from hno.report.palette import DARK, FONT, LIGHT, Palette, chart_config, signals
from hno.report.runs import NOT_AVAILABLE, Run, Sweep
from hno.report.tables import CACHED, generic, label_tables, names_of, recipe_table, run_table

LIMIT = 3_000_000
"""Most bytes of a page."""
SECTION_BYTES = 800_000
"""Most bytes of further evaluations."""
ASSETS = files("hno.report") / "assets"
SCRIPTS = ("base.js", "filters.js", "tables.js", "charts.js", "player.js", "refresh.js")


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
    """The page as text; further evaluations take what room the rest leaves, then episodes."""
    content, data = _content(sweep, refresh)
    told = further(sweep.runs)
    content |= {"sections": [], "sections_total": len(told)}
    content["sections"] = fitting(told, min(SECTION_BYTES, _room(content, data)))
    return _fill(content, data, payload.episodes(sweep.runs, max(0, _room(content, data))))


def _room(content: Mapping[str, Any], data: Mapping[str, Any]) -> int:
    """Bytes that a page without episodes leaves, with some to spare."""
    return LIMIT - len(_fill(content, data, payload.Budgeted([], 0, 0)).encode()) - 20_000


def _fill(content: Mapping[str, Any], data: Mapping[str, Any], played: payload.Budgeted) -> str:
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string((ASSETS / "page.html.j2").read_text(encoding="utf-8"))
    return template.render(**content, played=played, data=embedded({**data, "episodes": played.content}))


def embedded(content: Any) -> Markup:
    """JSON that no text inside can leave: nothing in it looks like markup."""
    text = json.dumps(content, separators=(",", ":"), sort_keys=True, allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


def _content(sweep: Sweep, refresh: float | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the template shows, and what the script works with, but for episodes."""
    found = recipes(sweep.runs)
    cards = _cards(sweep.runs, found)
    tables = [(card["id"], card.pop("table")) for card in cards]
    maps = payload.maps(tables)
    curves = payload.learning_curves(sweep.runs, {run.name: recipe.name for recipe in found for run in recipe.runs})
    data = {
        "maps": maps,
        "intervals": payload.intervals(rows for name, rows in tables if name in maps),
        "comparison": payload.comparison(found),
        "curves": curves.content,
        "charts": specifications(),
        "themes": {
            name: {"config": chart_config(p), "signals": signals(p)} for name, p in (("light", LIGHT), ("dark", DARK))
        },
        "refresh": refresh,
    }
    content = {
        **_results(sweep, found),
        **_origin(sweep, found),
        "cards": [card for card in cards if card["id"] in maps],
        "cards_total": len(cards),
        "curves": curves,
        "curve_games": sorted({entry["game"] for entry in curves.content}),
        "refresh": refresh,
        "variables": {"light": _variables(LIGHT), "dark": _variables(DARK)},
        "style": Markup(_asset("page.css")),
        "vega": Markup(_script(library())),
        "script": Markup(_script("\n".join(_asset(name) for name in SCRIPTS))),
    }
    return content, data


def _results(sweep: Sweep, found: Sequence[Recipe]) -> dict[str, Any]:
    """What came of the runs, and which of them say nothing."""
    return {
        "name": sweep.name,
        "jobs": words.jobs(sweep),
        "games": _games(found),
        "filters": {name: _choices(sweep.runs, name) for name in ("game", "operator", "activation", "seed")},
        "cached": CACHED,
        "recipe_table": recipe_table(found),
        "run_table": run_table(sweep.runs),
        "problems": [(run.name, run.status, words.why(run)[:600]) for run in sweep.runs if not run.finished],
        "skipped": sweep.skipped,
        "notes": [(run.name, note) for run in sweep.runs for note in run.notes],
        "repeated": [run.name for recipe in found for run in recipe.repeated],
        "compared_games": sorted({recipe.game for recipe in found if recipe.rate.starts}),
        "labels": label_tables(sweep.runs),
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


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def _script(text: str) -> str:
    """A script that may stand in a page: it leaves no names behind, and nothing in it ends the element."""
    closed = text.replace("</script", "<\\/script").replace("<!--", "<\\!--")
    return f"(() => {{\n{closed}\n}})();"


def _variables(palette: Palette) -> Markup:
    names = {name: value for name, value in palette._asdict().items() if isinstance(value, str)}
    players = {f"player-{k + 1}": color for k, color in enumerate(palette.category[:4])}
    scale = _gradient(palette)
    pairs = {**names, **players, "rates": scale, "font": FONT}
    return Markup("".join(f"--{name}:{value};" for name, value in pairs.items()))


INFERNO = (
    "#000004", "#160b39", "#420a68", "#6a176e", "#932667", "#bc3754", "#dd513a", "#f37819", "#fca50a", "#f6d746",
    "#fcffa4",
)  # fmt: skip
"""The scale of heat maps in steps of a tenth, for the legend."""


def _gradient(palette: Palette) -> str:
    start, end = (round(10 * part) for part in palette.rates)
    stops = INFERNO[start : end + 1] if start < end else INFERNO[end : start + 1][::-1]
    return f"linear-gradient(to right,{','.join(stops)})"


def _games(found: Sequence[Recipe]) -> list[dict[str, Any]]:
    """One card of the summary for every game."""
    chosen: dict[str, list[Recipe]] = {}
    for recipe in best(found).values():
        chosen.setdefault(recipe.game, []).append(recipe)
    sentences: dict[str, list[str]] = {}
    for game, _, text in words.verdicts(found):
        sentences.setdefault(game, []).append(text)
    games = sorted({recipe.game for recipe in found})
    return [_game(game, chosen.get(game, []), sentences.get(game, [])) for game in games]


def _game(game: str, chosen: Sequence[Recipe], sentences: Sequence[str]) -> dict[str, Any]:
    if not chosen:
        text = f"Nothing was played: the collision rate is {NOT_AVAILABLE}."
        return {"name": game, "quality": "unknown", "rate": NOT_AVAILABLE, "best": "", "n": "", "sentences": [text]}
    first = headline(chosen)
    counts = f"{first.rate.collisions:,} of {first.rate.starts:,}"
    return {
        "name": game, "quality": words.quality(first.rate), "rate": words.percent(first.rate.value),
        "best": f"{first.name} ({first.conditions})", "n": counts, "sentences": list(sentences),
    }  # fmt: skip


def _cards(runs: Sequence[Run], found: Sequence[Recipe]) -> list[dict[str, Any]]:
    """Heat maps of recipes over their seeds, safest first, then those of single runs."""
    ordered = sorted(found, key=lambda recipe: (recipe.game, recipe.rate.value or 0.0))
    pooled = [
        _card(f"r{k}", names_of(one, "recipe"), one.name, words.seeds(one), one.table)
        for k, one in enumerate(ordered)
        if one.runs
    ]
    names = {run.name: recipe.name for recipe in found for run in recipe.runs}
    single = [
        _card(f"s{k}", names_of(run, "run"), names.get(run.name, run.operator), f"seed {run.seed}", run.table)
        for k, run in enumerate(runs)
    ]
    return [card for card in (*pooled, *single) if card["table"]]


def _card(identifier: str, names: Mapping[str, str], title: str, counted: str, rows: Sequence[Any]) -> dict[str, Any]:
    counts, most = total(rows), worst(rows)
    at = f", worst {words.theta(most.theta)}" if most is not None and most.collisions else ""
    return {
        "id": identifier, "names": names, "title": title, "quality": words.quality(counts), "counted": counted,
        "text": words.share(counts),
        "interval": words.interval(counts.interval), "worst": at, "table": rows,
        "map": bool(rows) and len(rows[0].theta) == 2,
    }  # fmt: skip


def _choices(runs: Sequence[Run], name: str) -> list[str]:
    values = {getattr(run, name) for run in runs}
    numbers = sorted(value for value in values if isinstance(value, int))
    return [str(value) for value in numbers] or sorted(str(value) for value in values if value is not None)


def _settings(runs: Sequence[Run], found: Sequence[Recipe]) -> tuple[dict[str, str], Any]:
    """Settings that all runs share, and a table of the others by recipe."""
    keys = list(dict.fromkeys(key for run in runs for key in run.settings))
    values = {key: {run.settings.get(key) for run in runs} for key in keys}
    common = {key: str(next(iter(values[key])))[:300] for key in keys if len(values[key]) == 1}
    rest = [key for key in keys if len(values[key]) > 1 and key != "seed"]
    rows = [
        {"game": one.game, "recipe": one.name, **{key: one.runs[0].settings.get(key) for key in rest}}
        for one in found
        if one.runs
    ]
    return common, generic(rows) if rest and rows else None


def _versions(runs: Sequence[Run]) -> list[tuple[str, str]]:
    """Packages and the versions that runs had."""
    found: dict[str, dict[str, int]] = {}
    for run in runs:
        entries = run.content.get("versions")
        for package, version in entries.items() if isinstance(entries, dict) else ():
            counts = found.setdefault(str(package), {})
            counts[str(version)] = counts.get(str(version), 0) + 1
    return [
        (
            package,
            next(iter(counts)) if len(counts) == 1 else ", ".join(f"{v} ({n} runs)" for v, n in sorted(counts.items())),
        )
        for package, counts in found.items()
    ]
