"""Trains recipes over games and seeds, and compares them also where they were not trained.

    python benchmarks/recipes.py --set hypothesis --games lane_change --seeds 0 1 2

Sets of recipes are in recipe_sets.py; `--recipe "name: overrides"` adds one. Runs that are there with the same
configuration are not repeated: each keeps its results in `outputs/recipes/<set>/<game>/<recipe>/<seed>/`. Recipes are
chosen on validation starts (`--suites validation`); the other suites use test starts. All of them count starts whose
equilibrium keeps 2 cm. Prints a table per game, with counts pooled over seeds and 95 % intervals, and as its last line
one JSON object.
"""

from __future__ import annotations

import argparse
import json
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import annealed  # noqa: F401  # registers a loss term
import torch
from recipe_sets import FEWER, MOST, RECIPES, SUITES, VALUES
from rich.console import Console
from rich.table import Table

from hno.cli.calls import train_settings
from hno.cli.results import Results
from hno.cli.settings import TrainSettings
from hno.cli.train import train_operator
from hno.control import Feedback
from hno.control.rollout import rollout
from hno.data.certificates import safe
from hno.data.labels import Request, default_cache, safe_labels_for
from hno.evaluation.metrics import clopper_pearson
from hno.games import Box, make
from hno.training.checkpoint import load_policy
from hno.training.validation import Starts, starts_of
from hno.types import part

Cases = dict[str, tuple[Starts, list[int]]]
"""Starts of suites that were loaded, and how many there are of each type."""


def run(settings: TrainSettings, folder: Path) -> dict[str, Any]:
    """Train one recipe, or read what is there."""
    path, config = folder / "results.json", json.loads(settings.model_dump_json())
    if path.exists():
        content = json.loads(path.read_text())
        if content["status"] == "trained" and content.get("config") == config:
            return content
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "suites.json").unlink(missing_ok=True)
    head = {
        "game": settings.game.name,
        "operator": settings.operator.name,
        "seed": settings.seed,
        "config": config,
    }
    results = Results(path, head)
    try:
        train_operator(settings, folder, results)
        results.update(status="trained")
    except RuntimeError as error:
        results.update(status="failed", reason=str(error))
    return results.content


def starts(game_name: str, suite: str) -> tuple[Starts, list[int]]:
    """Safe starts of a suite, and how many there are of each type."""
    chosen, game = SUITES[suite], make(game_name)
    if chosen.box is not None:
        game.initial_box = Box(*chosen.box)
    count = max(1, round(FEWER.get(game_name, 1.0) * chosen.starts))
    seed = 0 if chosen.split == "validation" else 1000
    kind = seed, chosen.split, chosen.widen, chosen.symmetric, chosen.ties
    requests = [Request(theta, count, *kind) for theta in chosen.types]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # types beyond the box are meant
        most = count if chosen.ties else MOST.get(suite, 4096)
        found, _ = safe_labels_for(game, requests, default_cache(), most=most)
    kept = [part(labels, safe(labels)) for labels in found]
    return starts_of(kept), [len(labels.status) for labels in kept]


def play(policy: Feedback, suite: str, at: Starts, sizes: Sequence[int]) -> dict[str, Any]:
    """Collisions by type and the excess of joint costs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        played = rollout(policy.game, policy, at.x0, at.theta, disturbance=SUITES[suite].disturbance)
    hit = ~(played.clearance > 0)
    excess = -played.value.sum(-1) - at.cost
    return {
        "collisions": [int(part.sum()) for part in hit.split(list(sizes))],
        "starts": list(sizes),
        "excess": float(excess.median() / at.cost.median()),
        "mean_excess": float(excess[~hit].mean() / at.cost.mean()),
    }


def evaluate(folder: Path, game: str, suites: Sequence[str], cases: Cases) -> dict[str, Any]:
    """Every suite for one trained run; what was evaluated before is read."""
    path = folder / "suites.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    policy = load_policy(folder / json.loads((folder / "results.json").read_text())["checkpoint"])
    for suite in suites:
        if suite not in found:
            if suite not in cases:
                cases[suite] = starts(game, suite)
            found[suite] = play(policy, suite, *cases[suite])
            path.write_text(json.dumps(found))
    return found


def pooled(rows: Sequence[dict[str, Any]], suite: str) -> dict[str, Any]:
    """Counts over seeds with the interval of their rate, the worst type, and the median over seeds of the excess."""
    parts = [row["suites"][suite] for row in rows]
    hits = torch.tensor([part["collisions"] for part in parts]).sum(0)
    counts = torch.tensor([part["starts"] for part in parts]).sum(0)
    rates = hits / counts.clamp_min(1)
    worst = int(rates.argmax())
    total, among = int(hits.sum()), int(counts.sum())
    return {
        "collisions": total,
        "starts": among,
        "interval": clopper_pearson(total, among),
        "worst_type": SUITES[suite].types[worst],
        "worst_rate": float(rates[worst]),
        "excess": float(torch.tensor([part["excess"] for part in parts]).median()),
    }


def cell(found: dict[str, Any]) -> str:
    """Collisions, interval and excess in one cell."""
    low, high = found["interval"]
    total = f"{found['collisions']} of {found['starts']:,}"
    return f"{total} ({100 * low:.2f} to {100 * high:.2f} %), {100 * found['excess']:+.1f} %"


def compared(
    game: str, name: str, overrides: str, arguments: argparse.Namespace, cases: Cases
) -> dict[str, Any] | None:
    """One recipe over the seeds: medians, and every suite pooled; None if no seed could be trained."""
    rows = []
    for seed in arguments.seeds:
        fixed = [f"game={game}", f"seed={seed}", f"trainer.threads={arguments.threads}", "logger=csv"]
        before = "" if "function=" in overrides else VALUES
        settings = train_settings([*fixed, *before.split(), *overrides.split()])
        folder = arguments.out / arguments.set / game / name / str(seed)
        content = run(settings, folder)
        if content["status"] != "trained":
            print(f"{game} {name} seed {seed} failed: {content['reason']}")
            continue
        suites = evaluate(folder, game, arguments.suites, cases)
        rows.append({"seconds": content["seconds"], "metrics": content["metrics"], "suites": suites})
    if not rows:
        return None
    return {
        "seconds": float(torch.tensor([row["seconds"]["training"] for row in rows]).median()),
        "costate_error": float(torch.tensor([row["metrics"]["val/costate_error"] for row in rows]).median()),
        "seeds": len(rows),
        "suites": {suite: pooled(rows, suite) for suite in arguments.suites},
    }


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", default="adhoc", help=f"one of {', '.join(RECIPES)}, or a name for --recipe's")
    parser.add_argument("--games", nargs="+", default=["narrow_road", "lane_change", "drone"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--recipe", action="append", default=[], help='"name: overrides"')
    parser.add_argument("--only", nargs="+", help="names of recipes of the set")
    parser.add_argument("--suites", nargs="*", default=["validation"], choices=sorted(SUITES))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("outputs/recipes"))
    return parser.parse_args()


def chosen(arguments: argparse.Namespace) -> dict[str, str]:
    """Overrides by the names of the recipes that are asked for."""
    recipes = RECIPES.get(arguments.set, {}) | dict(map(str.strip, text.split(":", 1)) for text in arguments.recipe)
    missing = [name for name in arguments.only or recipes if name not in recipes]
    if missing or not recipes:
        known = ", ".join(recipes) or f"none; sets are {', '.join(RECIPES)}"
        raise SystemExit(f"No recipe {', '.join(missing)} in {arguments.set!r}. Known: {known}.")
    return {name: text for name, text in recipes.items() if not arguments.only or name in arguments.only}


def main() -> None:
    """Train, evaluate, print."""
    arguments = options()
    recipes = chosen(arguments)
    for name in ("lightning.pytorch", "lightning.pytorch.utilities.rank_zero", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning.*|torch.*")
    torch.set_num_threads(arguments.threads)
    console, everything = Console(width=60 + 50 * len(arguments.suites)), {}
    for game in arguments.games:
        cases: Cases = {}
        table = Table("recipe", "seconds", "costates", *arguments.suites, title=game)
        for name, overrides in recipes.items():
            found = compared(game, name, overrides, arguments, cases)
            if found is not None:
                cells = f"{found['seconds']:.0f}", f"{found['costate_error']:.3f}", *map(cell, found["suites"].values())
                table.add_row(name, *cells)
                print(f"{game}, {name}:", " | ".join(cells), flush=True)
                everything[f"{game}/{name}"] = found
        console.print(table)
    print(json.dumps(everything))


if __name__ == "__main__":
    main()
