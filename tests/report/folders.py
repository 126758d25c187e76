"""Folders as train.py leaves them, with made-up numbers: `python -m tests.report.folders <folder> <runs>`."""

from __future__ import annotations

import functools
import itertools
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from hno.evaluation.closed_loop import TypeRow
from hno.evaluation.metrics import clopper_pearson
from hno.evaluation.outcome import Outcome

GRID5 = tuple(itertools.product((1.0, 2.0, 3.0, 4.0, 5.0), repeat=2))
GRID9 = tuple(itertools.product(np.arange(1, 5.5, 0.5).tolist(), repeat=2))
CORNERS = {(1.0, 1.0), (1.0, 5.0), (5.0, 1.0), (5.0, 5.0)}
STARTS = 200
RADIUS = {"narrow_road": 1.25, "lane_change": 2.25, "drone": 0.5}
GAMES = ("narrow_road", "lane_change", "drone")
OPERATORS = ("hno", "sno")
ACTIVATIONS = ("tanh", "sin", "relu")


interval = functools.cache(clopper_pearson)


def row(theta: tuple[float, ...], collisions: int, starts: int = STARTS, **entries: Any) -> dict[str, Any]:
    """A row of the collision table."""
    some = starts > 0
    outcome = Outcome(
        starts=starts, unsolved=0, inevitable=0, marginal=0, marginal_collisions=0, safe_starts=starts,
        collisions=collisions, rate=collisions / starts if some else None, interval=interval(collisions, starts),
        median_min_distance=2.0 if some else None, distance_quantiles=(1.0, 1.5, 2.0) if some else None,
        median_excess_cost=0.1 if some else None, largest_excess_cost=1.0 if some else None,
        median_excess_costs=(0.05, 0.05) if some else None, median_label_cost=10.0 if some else None,
        saturated=0.1 if some else None,
    )  # fmt: skip
    return TypeRow(theta, theta in CORNERS, False, False, outcome, 0.02, 0.04).content() | entries


def collision_radius(game: str, theta: tuple[float, ...]) -> float:
    return 0.1 * sum(theta) + 0.05 * min(theta) + RADIUS.get(game, 1.0)


def make_episode(game: str, theta: tuple[float, ...], kind: str, gap: float, frames: int = 51) -> dict[str, Any]:
    """Two players who pass each other and come as close as the collision radius plus a gap."""
    radius = collision_radius(game, theta)
    t = np.linspace(0, 3, frames)
    near = (radius + gap) / 2

    def paths(offset: float) -> np.ndarray:
        bump = offset * np.exp(-(((t - 1.5) / 0.5) ** 2))
        if game == "drone":
            way = 0.4 + 3.2 * t
            one = np.stack([way, way, bump], -1)
            other = np.stack([10.4 - way, 10.4 - way, -bump], -1)
        else:
            one = np.stack([17 + 20 * t, 4 + bump], -1)
            other = np.stack([77 - 20 * t, 4 - bump], -1)
        return np.stack([one, other], 1)

    return {
        "theta": list(theta), "kind": kind, "collided": gap <= 0, "clearance": gap, "distance": radius + gap,
        "cost": 12.3, "label_cost": 12.0, "t": t.round(3).tolist(), "positions": paths(near).round(3).tolist(),
        "radius": [round(radius, 4)] * frames, "label_positions": paths(near + 0.4).round(3).tolist(),
    }  # fmt: skip


def make_results(
    game: str, operator: str, activation: str, seed: int, rng: np.random.Generator, types: Any = GRID5, **entries: Any
) -> dict[str, Any]:
    """results.json of a finished run."""
    level = {"tanh": 0.0008, "sin": 0.012, "relu": 0.12}.get(activation, 0.01) * (0.6 if operator == "sno" else 1.3)
    table = []
    for theta in types:
        rate = min(0.9, level * (0.2 + (theta[0] + theta[1]) / 6) * (0.4 if theta in CORNERS else 1.5))
        table.append(row(theta, int(rng.binomial(STARTS, rate)), median_excess_cost=float(rng.normal(0.2, 0.1))))
    config = {
        "game": {"name": game, "constants": {}}, "operator": {"name": operator, "width": 64, "depth": 4},
        "function": {"name": "value", "members": 1},
        "activation": {"name": activation}, "optimizer": {"name": "soap", "lr": 0.003}, "seed": seed,
        "trainer": {"max_steps": 2000, "threads": 1},
        "data": {"types": [list(t) for t in sorted(CORNERS)], "cache": None},
    }  # fmt: skip
    return {
        "status": "finished", "reason": None, "game": game, "operator": operator, "function": "value",
        "activation": activation,
        "seed": seed, "steps": 2000, "training_hash": "0" * 16, "checkpoint": "best.ckpt",
        "seconds": {"labels": 36.0, "training": round(50 + 20 * rng.random(), 1), "validation": 6.0, "evaluation": 8.0},
        "metrics": {"loss/total": 0.05, "val/value_error": 0.02, "val/costate_error": 0.04},
        "validation": {"collision_rate": 0.0, "excess": -0.008}, "config": config,
        "label_statistics": [
            {
                "theta": list(theta), "starts": 160, "status": {"converged": 158, "stalled": 2, "max_steps": 0},
                "safe": 150, "inevitable": 2, "largest_residual": 3e-9, "largest_reintegration": 2e-6,
                "largest_local_gap": 4e-6, "largest_global_gap": None, "above_local_gap": 0, "above_global_gap": 1,
            }
            for theta in sorted(CORNERS)
        ],
        "clearance": 0.02, "constraint_unit": "m", "dt": 0.02, "widen": 1.0, "noise": 0.0, "delay": 0,
        "test_seed": 1000, "table": table, "episodes": "episodes.json",
        "versions": {"hno": "0.1.0", "python": "3.11.2", "torch": "2.13.0", "lightning": "2.6.6"}, **entries,
    }  # fmt: skip


def write_run(
    folder: Path, results: dict[str, Any], *, steps: int = 40, extras: bool = True, episode_types: int = 25
) -> Path:
    """A run's folder: results, metrics, episodes and what Hydra writes."""
    (folder / ".hydra").mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps(results))
    choices = {key: results.get(key) for key in ("game", "operator", "function", "activation", "seed")}
    hydra = {"job": {"name": "train"}, "overrides": {"task": [f"{key}={value}" for key, value in choices.items()]}}
    (folder / ".hydra" / "hydra.yaml").write_text(json.dumps({"hydra": hydra}))
    if not extras:
        return folder
    rng = np.random.default_rng(list(folder.name.encode()))
    lines = [
        "closed_loop/collision_rate,epoch,loss/costate,loss/total,loss/value,step,val/costate_error,val/value_error"
    ]
    pace = {"tanh": 8, "sin": 9, "relu": 13}.get(results["activation"], 9)
    for k in range(steps):
        step = (k + 1) * 50 - 1
        value, costate = (
            (math.exp(-k / pace) + 0.02) * rng.uniform(0.9, 1.1),
            (math.exp(-k / pace / 1.3) + 0.04) * rng.uniform(0.9, 1.1),
        )
        lines.append(f",0,{costate},{value + costate},{value},{step},,")
        if k % 8 == 7:
            lines.append(f"{max(0.0, 0.5 - k / 50)},0,,,,{step},{costate},{value}")
    (folder / "csv").mkdir(exist_ok=True)
    (folder / "csv" / "metrics.csv").write_text("\n".join(lines) + "\n")
    write_episodes(folder, results, rng, episode_types)
    return folder


def write_episodes(folder: Path, results: dict[str, Any], rng: np.random.Generator, episode_types: int) -> None:
    """episodes.json: the worst and a typical episode of every type."""
    game = results["game"]
    entries = [
        make_episode(game, tuple(entry["theta"]), kind, gap)
        for entry in results["table"][:episode_types]
        for kind, gap in (("worst", -0.3 if entry["collisions"] else 0.02 + 0.1 * rng.random()), ("typical", 0.6))
    ]
    content = {"game": game, "players": 2, "dimensions": 3 if game == "drone" else 2, "episodes": entries}
    (folder / "episodes.json").write_text(json.dumps(content))


def write_sweep(root: Path, count: int, *, types: Any = GRID5) -> Path:
    """A sweep of finished runs with one that failed and one that was lost."""
    recipes = list(itertools.product(GAMES, OPERATORS, ACTIVATIONS))
    for job in range(count):
        game, operator, activation = recipes[job % len(recipes)]
        seed = job // len(recipes)
        results = make_results(game, operator, activation, seed, np.random.default_rng([job, 7]), types)
        if job == count - 1 and count > 1:
            results |= {"status": "failed", "reason": "DivergedError: the loss is not finite at step 350.", "table": []}
        elif job == count - 2 and count > 2:
            results |= {"status": "running", "table": [], "episodes": None}
        write_run(
            root / f"{job}_{game}_{operator}_{activation}", results, episode_types=25 if job < len(recipes) else 3
        )
    seeds = ",".join(str(seed) for seed in range(-(-count // len(recipes))))
    task = [
        f"game={','.join(GAMES)}",
        f"operator={','.join(OPERATORS)}",
        f"activation={','.join(ACTIVATIONS)}",
        f"seed={seeds}",
    ]
    lines = ["hydra:", "  job:", "    name: train", "  overrides:", "    task:", *(f"    - {entry}" for entry in task)]
    (root / "multirun.yaml").write_text("\n".join(lines) + "\n")
    return root


if __name__ == "__main__":
    write_sweep(Path(sys.argv[1]), int(sys.argv[2]))
