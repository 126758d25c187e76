"""Trains recipes over games and seeds, and compares them also where they were not trained.

    python benchmarks/recipes.py --set hypothesis --games lane_change --seeds 0 1 2

Sets of recipes are in `RECIPES`; `--recipe "name: overrides"` adds one. Runs that are there are not repeated: each
keeps its results in `outputs/recipes/<set>/<game>/<recipe>/<seed>/`. Recipes are chosen on validation starts
(`--suites validation`); the other suites use test starts. All of them count starts whose equilibrium keeps 2 cm.
Prints a table per game, with counts pooled over seeds and 95 % intervals, and as its last line one JSON object.
"""

from __future__ import annotations

import argparse
import itertools
import json
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from hno.cli.config import config_dir
from hno.cli.results import Results
from hno.cli.train import fit
from hno.data.labels import Request, default_cache, safe_labels_for
from hno.data.trust import safe
from hno.evaluation.metrics import clopper_pearson
from hno.evaluation.rollout import Disturbance, rollout
from hno.evaluation.validation import Starts, starts_of
from hno.games import make
from hno.operators.checkpoint import OperatorPolicy, load_policy
from hno.types import part

GRID5 = [(float(a), float(b)) for a, b in itertools.product(range(1, 6), repeat=2)]
GRID9 = [(a / 2, b / 2) for a, b in itertools.product(range(2, 11), repeat=2)]
BEYOND = [(1.0, 6.0), (3.0, 6.0), (5.0, 6.0), (5.5, 5.5), (6.0, 6.0)]


class Suite(NamedTuple):
    """Episodes that recipes are compared on."""

    types: Sequence[tuple[float, float]]
    """Player types."""
    starts: int
    """Safe starts per type."""
    widen: float = 1.0
    """Width of the start box in units of the game's."""
    split: str = "test"
    """Of the starts."""
    disturbance: Disturbance = Disturbance()
    """Of the controls."""


SUITES = {
    "validation": Suite(GRID5, 200, split="validation"),
    "integer types": Suite(GRID5, 200),
    "half types": Suite(GRID9, 20),
    "beyond": Suite(BEYOND, 60),
    "1.5 x box": Suite(GRID5, 40, widen=1.5),
    "2 x box": Suite(GRID5, 40, widen=2.0),
    "noise": Suite(GRID5, 40, disturbance=Disturbance(noise=0.2)),
    "delay": Suite(GRID5, 40, disturbance=Disturbance(delay=1)),
}
FEWER = {"drone": 0.3}
"""Share of the starts above that a game gets, because most of its starts collide inevitably."""
MOST = {"half types": 256, "beyond": 512, "1.5 x box": 256, "2 x box": 256}
"""Start states of a type after which the search for safe ones ends, where it is not 4096."""

CORNERS = "data.types=[[1,1],[1,5],[5,1],[5,5]]"
STEPS = "trainer.max_steps=1000 optimizer.lr=1e-2"
SHORT = f"operator=sno {STEPS}"
FIFTEEN = str([[a, b] for a, b in itertools.combinations_with_replacement(range(1, 6), 2)]).replace(" ", "")
TEN = f"{STEPS} {CORNERS} data.trajectories=10"
ANY = f"{STEPS} {CORNERS} operator=hno data.interior_types=box data.trajectories=200"
RECIPES: dict[str, dict[str, str]] = {
    "default": {"sno": "operator=sno", "hno": "operator=hno"},
    "hypothesis": {
        "sno": f"{STEPS} operator=sno",
        "hno": f"{STEPS} operator=hno",
        "sno, time of hno": f"{STEPS} trainer.max_steps=1250 operator=sno",
        "sno, corners": f"{STEPS} {CORNERS} operator=sno data.trajectories=200",
        "hno, corners": f"{STEPS} {CORNERS} operator=hno data.trajectories=200",
        "sno, corners, 50": f"{STEPS} {CORNERS} operator=sno data.trajectories=50",
        "hno, corners, 50": f"{STEPS} {CORNERS} operator=hno data.trajectories=50",
    },
    "activations": {
        f"{name} {rate}": f"operator=sno activation={name} optimizer.lr={rate} trainer.max_steps=1000"
        for name, rate in itertools.product(("tanh", "relu", "sin", "sin activation.frequency=10"), (1e-3, 3e-3, 1e-2))
    },
    "optimizers": {
        "soap 1e-2": SHORT,
        "soap 3e-3": f"{SHORT} optimizer.lr=3e-3",
        "soap 1e-2, polish": f"{SHORT} trainer.polish=100",
        "soap 1e-2, linear": f"{SHORT} optimizer.schedule=linear",
        "soap 1e-2, clip 1": f"{SHORT} trainer.gradient_clip_val=1.0",
        "adam 3e-3": f"{SHORT} optimizer=adam optimizer.lr=3e-3",
        "adam 1e-2": f"{SHORT} optimizer=adam optimizer.lr=1e-2",
        "adamw 1e-2": f"{SHORT} optimizer=adamw optimizer.lr=1e-2",
        "muon 2e-2": f"{SHORT} optimizer=muon optimizer.lr=2e-2",
    },
    "losses": {
        "huber": f"{SHORT} loss.norm=huber",
        "l2": f"{SHORT} loss.norm=l2",
        "free terminal value": f"{SHORT} operator.exact_terminal=false",
        "balance": f"{SHORT} loss.balance=true",
        "costate 3": f"{SHORT} loss.weights.costate=3",
        "physical units": f"{SHORT} loss.scaled=false",
        "batch 1024, twice the steps": f"{SHORT} data.batch_sizes.bvp=1024 trainer.max_steps=2000",
        "batch 4096, half the steps": f"{SHORT} data.batch_sizes.bvp=4096 trainer.max_steps=500",
    },
    "samplers": {
        "mixed": f"{SHORT} operator=hno",
        "uniform": f"{SHORT} operator=hno sampler=uniform",
        "band": f"{SHORT} operator=hno sampler=band",
        "labels": f"{SHORT} operator=hno sampler=labels",
        "rollout": f"{SHORT} operator=hno sampler=rollout",
        "hardest quarter": f"{SHORT} operator=hno loss.hardest=0.25",
    },
    "types": {
        "4 types x 280": f"{SHORT} {CORNERS} data.trajectories=280",
        "7 types x 160": SHORT,
        "15 types x 75": f"{SHORT} data.trajectories=75 data.types={FIFTEEN}",
    },
    "ten labels": {
        "sno": f"{TEN} operator=sno",
        "hno 0.02": f"{TEN} operator=hno",
        "hno 0.1": f"{TEN} operator=hno loss.weights.residual=0.1",
        "hno 0.1, around labels": f"{TEN} operator=hno loss.weights.residual=0.1 sampler=labels",
        "hno 0.002": f"{TEN} operator=hno loss.weights.residual=0.002",
    },
    "any type": {
        "0.1": f"{ANY} loss.weights.residual=0.1",
        "0.01": f"{ANY} loss.weights.residual=0.01",
        "0.1, around labels": f"{ANY} loss.weights.residual=0.1 sampler=labels",
        "0.1, rollouts": f"{ANY} loss.weights.residual=0.1 sampler=rollout",
        "0.1, whole horizon at once": f"{ANY} loss.weights.residual=0.1 data.widening=0",
    },
}
"""Overrides by name, by set."""


def run(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Train one recipe, or read what is there."""
    path = folder / "results.json"
    if path.exists():
        content = json.loads(path.read_text())
        if content["status"] == "trained":
            return content
    folder.mkdir(parents=True, exist_ok=True)
    results = Results(path, {"game": config.game.name, "operator": config.operator.name, "seed": config.seed})
    try:
        fit(config, folder, results)
        results.update(status="trained")
    except RuntimeError as error:
        results.update(status="failed", reason=str(error))
    return results.content


def starts(game_name: str, suite: str) -> tuple[Starts, list[int]]:
    """Safe starts of a suite, and how many there are of each type."""
    types, count, widen, split, _ = SUITES[suite]
    count = max(1, round(FEWER.get(game_name, 1.0) * count))
    game, seed = make(game_name), 0 if split == "validation" else 1000
    requests = [Request(theta, count, seed, split, widen) for theta in types]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # types beyond the box are meant
        found, _ = safe_labels_for(game, requests, default_cache(), most=MOST.get(suite, 4096))
    kept = [part(labels, safe(labels)) for labels in found]
    return starts_of(kept), [len(labels.status) for labels in kept]


def play(policy: OperatorPolicy, suite: str, at: Starts, sizes: Sequence[int]) -> dict[str, Any]:
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


def evaluate(
    folder: Path, game: str, suites: Sequence[str], cases: dict[str, tuple[Starts, list[int]]]
) -> dict[str, Any]:
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
    rate = 100 * found["collisions"] / found["starts"]
    return f"{rate:.2f} % ({100 * low:.2f} to {100 * high:.2f}) of {found['starts']}, {100 * found['excess']:+.1f} %"


def main() -> None:
    """Train, evaluate, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", default="adhoc", help=f"one of {', '.join(RECIPES)}, or a name for --recipe's")
    parser.add_argument("--games", nargs="+", default=["narrow_road", "lane_change", "drone"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--recipe", action="append", default=[], help='"name: overrides"')
    parser.add_argument("--only", nargs="+", help="names of recipes of the set")
    parser.add_argument("--suites", nargs="*", default=["validation"], choices=sorted(SUITES))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("outputs/recipes"))
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.ERROR)
    for name in ("lightning.pytorch", "lightning.pytorch.utilities.rank_zero", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning.*|torch.*")
    torch.set_num_threads(arguments.threads)
    recipes = RECIPES.get(arguments.set, {}) | dict(map(str.strip, text.split(":", 1)) for text in arguments.recipe)
    recipes = {name: text for name, text in recipes.items() if not arguments.only or name in arguments.only}
    console, everything = Console(width=60 + 50 * len(arguments.suites)), {}
    for game in arguments.games:
        cases: dict[str, tuple[Starts, list[int]]] = {}
        table = Table("recipe", "seconds", "costates", *arguments.suites, title=game)
        for name, overrides in recipes.items():
            rows = []
            for seed in arguments.seeds:
                with initialize_config_dir(str(config_dir()), version_base=None):
                    fixed = [f"game={game}", f"seed={seed}", f"trainer.threads={arguments.threads}", "logger=csv"]
                    config = compose("train", overrides=[*fixed, *overrides.split()])
                folder = arguments.out / arguments.set / game / name / str(seed)
                content = run(config, folder)
                if content["status"] == "trained":
                    suites = evaluate(folder, game, arguments.suites, cases)
                    rows.append({"seconds": content["seconds"], "metrics": content["metrics"], "suites": suites})
                else:
                    console.print(f"{game} {name} seed {seed} failed: {content['reason']}")
            if rows:
                found = {suite: pooled(rows, suite) for suite in arguments.suites}
                seconds = float(torch.tensor([row["seconds"]["training"] for row in rows]).median())
                costate = float(torch.tensor([row["metrics"]["val/costate_error"] for row in rows]).median())
                table.add_row(name, f"{seconds:.0f}", f"{costate:.3f}", *(cell(part) for part in found.values()))
                worst = {suite: [part["worst_type"], part["worst_rate"]] for suite, part in found.items()}
                console.print(game, name, f"{seconds:.0f} s", *(cell(part) for part in found.values()), worst)
                everything[f"{game}/{name}"] = {
                    "seconds": seconds,
                    "costate_error": costate,
                    "seeds": len(rows),
                    **found,
                }
        console.print(table)
    print(json.dumps(everything))


if __name__ == "__main__":
    main()
