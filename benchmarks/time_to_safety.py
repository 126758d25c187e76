"""Seconds until a controller has no collision on 200 safe validation starts at each of the 25 integer types.

    python benchmarks/time_to_safety.py [--games narrow_road lane_change drone] [--seeds 0 1 2] [--starts 200]

Trains `experiment=fast`, which ends as soon as that is so. "Safe after" is training with its validations, from cached
labels; "from nothing" adds the training labels, solved anew into an empty folder on all cores. The labels of the
validation starts only measure: they are solved before, and their seconds are in the JSON object of the last line.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from hno.cli.build import build
from hno.cli.calls import train_settings
from hno.cli.results import Results
from hno.cli.train import train_operator
from hno.data.labels import labels_for


def measure(game: str, seed: int, starts: int, threads: int, overrides: list[str]) -> dict[str, Any]:
    """One game and seed."""
    fixed = [f"game={game}", f"seed={seed}", f"validation.starts={starts}", f"trainer.threads={threads}", "logger=csv"]
    settings = train_settings(["experiment=fast", *fixed, *overrides])
    data = build(settings).data
    with tempfile.TemporaryDirectory() as folder:
        found, labels = labels_for(data.game, data.requests, Path(folder))
    with tempfile.TemporaryDirectory() as folder:
        results = Results(Path(folder) / "results.json", {})
        began = time.perf_counter()
        train_operator(settings, Path(folder), results)
        whole = time.perf_counter() - began
    seconds, best = results.content["seconds"], results.content["validation"]
    rate = best["collision_rate"]
    cached = whole - seconds["labels"] - seconds["validation_labels"]
    return {
        "safe": rate == 0.0,
        "collision_rate": rate,
        "excess": best["excess"],
        "steps": results.content["steps"],
        "training_labels": sum(len(part.status) for part in found),
        "label_s": labels,
        "training_s": seconds["training"],
        "validation_s": seconds["validation"],
        "cached_s": cached,
        "from_nothing_s": cached + labels,
        "validation_label_s": seconds["validation_labels"],
    }


def main() -> None:
    """Print the table and one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--games", nargs="+", default=["narrow_road", "lane_change", "drone"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--override", nargs="+", default=[])
    arguments = parser.parse_args()
    for name in ("lightning.pytorch", "lightning.pytorch.utilities.rank_zero", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning.*|torch.*")
    table = Table(
        "game", "seed", "safe after", "steps", "from nothing", "labels", "training", "validation", "excess cost"
    )
    everything = []
    for game in arguments.games:
        for seed in arguments.seeds:
            row = measure(game, seed, arguments.starts, arguments.threads, arguments.override)
            everything.append({"game": game, "seed": seed, **row})
            after = f"{row['cached_s']:.0f} s" if row["safe"] else f"never: {100 * row['collision_rate']:.2f} % collide"
            times = [f"{row[name]:.0f} s" for name in ("from_nothing_s", "label_s", "training_s", "validation_s")]
            table.add_row(game, str(seed), after, str(row["steps"]), *times, f"{100 * row['excess']:+.1f} %")
            print(json.dumps(everything[-1]), flush=True)
    Console(width=120).print(table)
    print(json.dumps({"threads": arguments.threads, "starts": arguments.starts, "runs": everything}))


if __name__ == "__main__":
    main()
