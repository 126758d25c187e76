"""What dashboards get at the end of a run: numbers by type, a map over types, pictures of episodes."""

from __future__ import annotations

import json
import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger

from hno.evaluation.format import NAMES, number, title
from hno.evaluation.outcome import pooled

log = logging.getLogger(__name__)

CHOSEN = (*NAMES, "seed", "training_hash")
"""What TensorBoard shows beside the numbers of a run."""


def publish(loggers: Sequence[Logger], results: Mapping[str, Any], folder: Path, step: int) -> None:
    """Send what came of a run to its loggers. One that refuses, or a failed picture, costs a warning, not the run.

    Args:
        loggers: all of them get the numbers; W&B pictures and the table too; TensorBoard pictures.
        results: content of results.json.
        folder: the run's; pictures are written there.
        step: the last one of the training.
    """
    pictures = draw(results, folder, {type(logger) for logger in loggers})
    for logger in loggers:
        try:
            logger.log_metrics(numbers(results), step)
            if isinstance(logger, TensorBoardLogger):
                logger.log_hyperparams({name: str(results.get(name)) for name in CHOSEN}, numbers(results), step)
                for name, path in pictures.items():
                    from PIL.Image import open as read  # pictures are drawn where it is installed only

                    logger.experiment.add_image(name, np.asarray(read(path)), step, dataformats="HWC")
            if isinstance(logger, WandbLogger):
                _send_to_wandb(logger, results["table"], pictures, step)
            logger.finalize("success")  # the end of the training finalized it before these numbers came
        except Exception as error:
            log.warning("%s did not take the results: %s", type(logger).__name__, error)


def numbers(results: Mapping[str, Any]) -> dict[str, float]:
    """Results under the names by which dashboards show them; what does not exist is left out."""
    whole, validation = pooled(results["table"]), results.get("validation") or {}
    found = {
        "test/collision_rate": whole.rate,
        "test/worst_type": whole.worst_rate,
        "test/excess_cost": whole.relative_excess,
        "test/safe_starts": whole.safe_starts,
        "best/collision_rate": validation.get("collision_rate"),
        "best/excess_cost": validation.get("excess"),
        **{f"collision_rate/{name_of(row['theta'])}": row["rate"] for row in results["table"]},
        **{f"robustness/{row['name']}": row["rate"] for row in results.get("robustness") or ()},
        **{f"seconds/{part}": seconds for part, seconds in results["seconds"].items()},
    }
    return {name: float(value) for name, value in found.items() if value is not None}


def name_of(theta: Sequence[float]) -> str:
    """Player types in one word."""
    return ",".join(f"{t:g}" for t in theta)


def draw(results: Mapping[str, Any], folder: Path, kinds: Collection[type[Logger]]) -> dict[str, Path]:
    """Draw into the folder what loggers of these kinds take; say what cannot be drawn.

    Returns:
        Names and files of the pictures.
    """
    made = {name: folder / f"{name}.png" for name in ("rollout", "worst_episode", "collision_map")}
    with harmless():
        from hno.report.pictures import collision_map

        if WandbLogger in kinds and (worst := worst_episode(results, folder)):
            smallest = f"{number(worst['clearance'])} {results.get('constraint_unit', 'm')}".strip()
            heading = f"most lost against the equilibrium at ({name_of(worst['theta'])}), clearance {smallest}"
            _draw_episode(worst, made["worst_episode"], f"{title(results)}\n{heading}")
        if {WandbLogger, TensorBoardLogger} & set(kinds):
            collision_map(results["table"], made["collision_map"], title(results))
    return {name: path for name, path in made.items() if path.exists()}


def draw_typical(episodes: Sequence[Mapping[str, Any]], path: Path, title: str) -> None:
    """Draw the first typical episode of episodes.json, if there is one; say what cannot be drawn."""
    with harmless():
        typical = next((entry for entry in episodes if entry["kind"] == "typical"), None)
        if typical is None:
            raise ValueError("no start has a safe equilibrium")
        _draw_episode(typical, path, title)


def _draw_episode(content: Mapping[str, Any], path: Path, title: str) -> None:
    from hno.report.episode import episode
    from hno.report.pictures import rollout_picture

    rollout_picture(episode(content), path, title)


@contextmanager
def harmless() -> Iterator[None]:
    """A picture that cannot be drawn costs a line in the log, not the run."""
    try:
        yield
    except (ModuleNotFoundError, OSError, ValueError) as error:
        log.info("No picture: %s", error)
    except Exception as error:
        log.warning("A picture could not be drawn: %s: %s", type(error).__name__, error)


def worst_episode(results: Mapping[str, Any], folder: Path) -> dict[str, Any] | None:
    """The stored episode that lost most against the equilibrium, see `Episode.order`; None if the run stored none."""
    from hno.report.episode import lost_most

    if not results.get("episodes"):
        return None
    episodes = json.loads((folder / results["episodes"]).read_text())["episodes"]
    return min(episodes, key=lost_most, default=None)


def _send_to_wandb(logger: WandbLogger, table: Sequence[Any], pictures: Mapping[str, Path], step: int) -> None:
    whole = pooled(table)
    nobody = "n/a" if whole.rate is None else "none"
    logger.experiment.summary["test/worst_theta"] = name_of(whole.worst_theta or ()) or nobody
    for name, path in pictures.items():
        logger.log_image(name, [str(path)], step)
    rows = [_flat(row) for row in table]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    logger.log_table("types", columns, [[row.get(name) for name in columns] for row in rows], step=step)


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the collision table with one number in every cell: types by name, lists with an entry's place."""
    found: dict[str, Any] = {"types": name_of(row["theta"])}
    for name, value in row.items():
        entries = value if isinstance(value, (list, tuple)) else [value]
        names = [name] if entries is not value else [f"{name}_{k + 1}" for k in range(len(entries))]
        found |= dict(zip(names, entries, strict=True))
    return found
