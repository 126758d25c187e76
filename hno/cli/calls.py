"""The commands as Python calls: `hno.train`, `hno.evaluate` and `hno.certify`."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hno.cli import certify as certification
from hno.cli import evaluate as evaluation
from hno.cli.arguments import Arguments, quoted
from hno.cli.build import check
from hno.cli.config import compose, for_hydra
from hno.cli.confs import groups
from hno.cli.output import fresh, owned
from hno.cli.results import Results, recorded
from hno.cli.settings import TrainSettings
from hno.cli.train import head, landscape_of, train_operator
from hno.games import Game, games
from hno.processes import interruptible_call
from hno.training.checkpoint import LearnedPolicy, load_policy


@interruptible_call()
def train(
    game: str | Game,
    method: str = "sno",
    folder: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
) -> LearnedPolicy:
    """Solve labels and train an operator, as `hno train` does, without its evaluation; its landscape is in the folder.

    Args:
        game: a registered name, or a game of a registered class.
        method: a list of loss terms, such as "hno" or "sno"; `hno list method` lists them.
        folder: where checkpoints and metrics go; by default a new one, `outputs/python` or with a number after it.
        settings: keys of `hno train --help` and their values, such as {"trainer.max_steps": 500, "activation": "tanh"}.

    Returns:
        The policy of the best checkpoint, or of the last one where validation did not play.

    Raises:
        ValueError, LookupError: settings that are unknown or make no sense; or the folder is another run's.
        DivergedError: the loss, or the error on held-out labels, is no longer sound.
        KeyboardInterrupt, SystemExit: a signal ended it; the folder has a checkpoint to go on from.
    """
    name = game if isinstance(game, str) else games.name_of(type(game))
    constants = {} if isinstance(game, str) else {f"game.constants.{k}": v for k, v in game.constants.items()}
    chosen = {"logger": "csv", "game": name, "operator": method, **constants, **(settings or {})}
    checked = train_settings(_overrides("train", chosen))
    place = fresh(Path("outputs/python")) if folder is None else Path(folder)
    with owned(place, checked.resume):
        results = Results(place / "results.json", head(checked))
        with recorded(results):
            policy = load_policy(train_operator(checked, place, results).checkpoint)
            results.update(**landscape_of(policy, checked, results))
    return policy


@interruptible_call()
def evaluate(
    checkpoint: str | Path, folder: str | Path | None = None, settings: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Evaluate a trained operator in closed loop, as `hno evaluate` does.

    Args:
        checkpoint: a checkpoint, or the folder of a run.
        folder: where results.json, episodes and a picture go; they are not kept by default.
        settings: keys of `hno evaluate --help` and their values, such as {"theta": "grid5", "starts": 50}.

    Returns:
        The content of results.json: `table` has the rows of `hno.evaluation.closed_loop`, one for each type.

    Raises:
        ValueError, LookupError: settings that are unknown or make no sense.
        CheckpointError: a checkpoint that cannot be read.
        KeyboardInterrupt, SystemExit: a signal ended it.
    """
    drawn = {"landscape": folder is not None}  # without a folder there is no page that shows it
    chosen = _overrides("evaluate", {"checkpoint": str(checkpoint), **drawn, **(settings or {})})
    checked = evaluation.check(compose("evaluate", for_hydra("evaluate", Arguments([], chosen, {}))))
    with tempfile.TemporaryDirectory() as nowhere:
        place = Path(nowhere if folder is None else folder)
        with owned(place):
            results = Results(place / "results.json", evaluation.head(checked))
            with recorded(results):
                evaluation.evaluate(checked, results)
    return results.content


@interruptible_call()
def certify(checkpoint: str | Path, settings: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Bound the probability of collision of a controller, as `hno certify` does; `certificate.json` lies beside it.

    Args:
        checkpoint: a checkpoint, the folder of a run, or an exported controller.
        settings: keys of `hno certify --help` and their values, such as {"tests": 10_000, "beta": 1e-6}.

    Returns:
        The content of certificate.json: `every`, `safe` and `region` as in `hno.evaluation.certificate`, and `text`.

    Raises:
        ValueError, LookupError: settings that are unknown or make no sense, or the tests chose the model.
        CheckpointError: a checkpoint that cannot be read.
        KeyboardInterrupt, SystemExit: a signal ended it.
    """
    chosen = _overrides("certify", {"checkpoint": str(checkpoint), **(settings or {})})
    return certification.write(certification.check(compose("certify", for_hydra("certify", Arguments([], chosen, {})))))


def train_settings(overrides: Sequence[str]) -> TrainSettings:
    """The checked settings of a training, from overrides as on the command line. Raises as `train`."""
    return check(compose("train", for_hydra("train", Arguments([], list(overrides), {}))))


def _overrides(name: str, settings: Mapping[str, Any]) -> list[str]:
    composed = groups(name)
    return [f"{key}={value if key in composed else _text(value)}" for key, value in settings.items()]


def _text(value: Any) -> str:
    """A value in Hydra's grammar."""
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{_text(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(map(_text, value)) + "]"
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    return quoted(str(value)) if isinstance(value, (str, Path)) else repr(value)
