"""`hno certify`: bounds on the probability of collision from tests that did not choose the model."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hno.cli.arguments import Arguments
from hno.cli.config import configured, read
from hno.cli.evaluate import Model, model, model_file
from hno.cli.logs import use_threads
from hno.cli.progress import collect_messages, label_progress
from hno.cli.results import versions, write_json
from hno.cli.settings import CertifySettings
from hno.control.exported import is_exported
from hno.control.rollout import control_steps
from hno.data.many import solve_many
from hno.evaluation.certificate import Certificate, Plan, certify
from hno.evaluation.statement import describe
from hno.games import Game
from hno.games.grid import parse_types
from hno.report.runs import RESULTS, read_json
from hno.runtime.artefact import MANIFEST

CERTIFICATE = "certificate.json"
"""Name of the file beside the checkpoint."""


def run(given: Arguments) -> int:
    """`hno certify`."""
    settings = configured("certify", check, given)
    if settings is not None:
        collect_messages()
        content = write(settings)
        print("\n".join([*content["text"], str(place_of(settings) / CERTIFICATE)]))
    return 0


def check(config: DictConfig) -> CertifySettings:
    """The settings of a certificate that can be made; nothing is played or written.

    Raises:
        ValueError, LookupError: entries that are unknown or make no sense; or the tests chose the model.
        CheckpointError, ArtefactError: a controller that cannot be read.
    """
    settings = read(CertifySettings, config)
    policy = model(model_file(settings.checkpoint), settings.expected_game)
    control_steps(policy.game, settings.dt)
    plan_of(settings, policy.game)
    check_independent(settings.seed, draws_of(policy, place_of(settings)))
    earlier(place_of(settings))
    return settings


def plan_of(settings: CertifySettings, game: Game) -> Plan:
    """What is tested. Raises ValueError for types that are none of the game's."""
    types = None if settings.theta == "box" else parse_types(game, settings.theta, key="theta", also=("box",))
    return Plan(**{name: entry for name, entry in settings if name in Plan._fields}, types=types)


def place_of(settings: CertifySettings) -> Path:
    """The folder in which the certificate lies: that of the checkpoint, or the exported controller."""
    path = Path(model_file(settings.checkpoint))
    return path if is_exported(path) else path.parent


def draws_of(policy: Model, folder: Path) -> list[list[Any]]:
    """Every draw of random states that made the model, and that of the evaluation whose results lie beside it.

    Raises:
        ValueError: the model does not say, or the results cannot be read.
    """
    draws = policy.origin().get("draws")
    if draws is None:
        raise ValueError(
            "The checkpoint does not list the starts that it was trained, validated and stopped by, so nobody can say "
            "that other ones test it: train it with `hno train`, or list them in Provenance(draws=...)."
        )
    path = folder / RESULTS
    tested = read_json(path).get("test_seed") if path.exists() else None
    return [*draws, *([["evaluation", "test", tested]] if isinstance(tested, int) else [])]


def check_independent(seed: int, draws: Sequence[Sequence[Any]]) -> None:
    """Raise ValueError where a seed made or chose the model.

    Tests have random numbers of their own, whatever their seed. A number that nothing else was drawn by is asked for
    all the same: that is what a reader of a certificate can check.
    """
    for use, split, used in draws:
        if used == seed:
            raise ValueError(
                f"seed={seed} made the model: {use} (split {split!r}) were drawn by it. Tests must not have chosen "
                f"what they test: leave seed out, or take a number other than "
                f"{', '.join(sorted({str(other) for *_, other in draws if other is not None}))}."
            )


def earlier(folder: Path) -> list[dict[str, Any]]:
    """Tests of earlier certificates in a folder: whoever makes many may pick the best, so all are kept.

    Raises:
        ValueError: the certificate that lies there cannot be read.
    """
    path = folder / CERTIFICATE
    if not path.exists():
        return []
    try:
        content = json.loads(path.read_text())
        return [*content["earlier"], {name: content[name] for name in ("checkpoint", "sha256", "settings")}]
    except (ValueError, LookupError, TypeError) as error:
        raise ValueError(f"{path} is no certificate of hno ({type(error).__name__}): move it away.") from error


def write(settings: CertifySettings) -> dict[str, Any]:
    """Test the controller and write its certificate. Returns what is in the file."""
    use_threads(settings.threads)
    file, folder = model_file(settings.checkpoint), place_of(settings)
    policy = model(file, settings.expected_game)
    with label_progress("equilibria of tests", functools.partial(print, flush=True)) as report:
        solve = functools.partial(solve_many, policy.game, workers=settings.workers, report=report)
        found = certify(policy, plan_of(settings, policy.game), solve)
    content = {
        "checkpoint": Path(file).name,
        "sha256": _digest(Path(file)),
        "names": policy.names(),
        "constants": dict(policy.game.constants),
        "fingerprint": policy.game.fingerprint(),
        "draws": draws_of(policy, folder),
        "settings": settings.model_dump(exclude={"checkpoint", "expected_game", "workers", "threads"}),
        **plain(found),
        "versions": versions(),
    }
    content["earlier"] = [one for one in earlier(folder) if {**content, **one} != content]
    content["text"] = describe(found, policy.game, content)
    write_json(folder / CERTIFICATE, content, indent=2)
    return content


def plain(found: Certificate) -> dict[str, Any]:
    """Bounds and region as JSON content."""
    parts = {name: getattr(found, name) for name in ("every", "safe", "region")}
    return {name: None if part is None else part._asdict() for name, part in parts.items()}


def _digest(file: Path) -> str:
    return hashlib.sha256((file / MANIFEST if file.is_dir() else file).read_bytes()).hexdigest()
