"""`python evaluate.py checkpoint=<path>`: how safe trained models are, and where they err."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from hno.cli import launch
from hno.cli.arguments import Arguments
from hno.cli.checkpoints import trained
from hno.cli.config import read
from hno.cli.logs import send_lightning_to_hydra, use_threads
from hno.cli.results import Results, config_hash, plain, write_json
from hno.cli.schema import Episodes, EvaluateSettings
from hno.cli.sections import check_sections, run_sections
from hno.cli.starts import cache_folder, solve_starts
from hno.cli.summary import report, show
from hno.control.rollout import Disturbance, control_steps, rollout
from hno.evaluation.closed_loop import TypeRow, classify, collided, play, tabulate
from hno.evaluation.comparison import check_same_game, compare
from hno.evaluation.episodes import EPISODES, episodes
from hno.games import Game
from hno.games.grid import parse_types
from hno.report.picture import PlotsMissingError, rollout_picture, typical
from hno.training.checkpoint import LearnedPolicy, load_policy
from hno.types import Extremal, Trajectory

log = logging.getLogger(__name__)


def run(given: Arguments) -> int:
    """`hno evaluate`."""
    return launch.run("evaluate", check, evaluate, given)


def check(config: DictConfig) -> EvaluateSettings:
    """The settings of an evaluation that can be made; nothing is solved or written.

    Raises:
        ValueError, LookupError: entries that are unknown or make no sense, together or for the game.
        CheckpointError: a checkpoint that cannot be read.
    """
    settings = read(EvaluateSettings, config)
    with warnings.catch_warnings(action="ignore"):  # the run warns
        policies, types = load(settings)
        for policy in policies:
            check_sections(policy, types, OmegaConf.create(plain(settings)))
    return settings


def load(settings: EvaluateSettings) -> tuple[list[LearnedPolicy], list[tuple[float, ...]]]:
    """The models to evaluate and the types at which to do so. Raises as `check`."""
    paths = checkpoints_of(settings)
    policies = [load_policy(path, settings.expected_game) for path in paths]
    check_same_game(list(map(str, paths)), [policy.game for policy in policies])
    check_evaluation(policies[0].game, settings)
    chosen = [types_to_evaluate(settings.theta, policy, settings.unseen) for policy in policies]
    return policies, list(dict.fromkeys(theta for own in chosen for theta in own))


def evaluate(settings: EvaluateSettings) -> bool:
    """Evaluate checkpoints and write results.json into the run's own folder.

    Returns:
        Whether it succeeded. A failure has been logged and is in results.json.
    """
    send_lightning_to_hydra()
    folder, paths = Path(HydraConfig.get().runtime.output_dir), list(map(str, checkpoints_of(settings)))
    head = {"checkpoint": paths[0], "config_hash": config_hash(settings), "config": plain(settings)}
    results = Results(folder / "results.json", head)
    try:
        evaluate_models(settings, paths, results)
    except Exception as error:
        results.update(status="failed", reason=f"{type(error).__name__}: {error}")
        report(error)
        return False
    except (KeyboardInterrupt, SystemExit):  # Lightning turns the one into the other
        results.update(status="failed", reason="interrupted")
        raise
    show(results.content, folder)
    return True


def checkpoints_of(settings: EvaluateSettings) -> list[Path]:
    """Files of the models: one, or several of a list."""
    given = settings.checkpoint
    return [trained(str(path)) for path in (given if isinstance(given, list) else [given])]


def evaluate_models(settings: EvaluateSettings, paths: Sequence[str], results: Results) -> None:
    """Evaluate the models of these files; every part is written into the results as it is done."""
    use_threads(settings.threads)
    policies, types = load(settings)
    game, config = policies[0].game, OmegaConf.create(plain(settings))
    results.update(**policies[0].names(), seed=policies[0].provenance.seed)
    labels = solve_tests(game, types, config, cache_folder(settings.cache), settings.workers, results)
    models, outcomes = list[dict[str, Any]](), list[Sequence[Tensor]]()
    for path, policy in zip(paths, policies, strict=True):
        log.info("evaluation of %s", path)
        found = assess(policy, labels, config, results) if models else evaluate_policy(policy, labels, config, results)
        outcomes.append(found.collided)
        table = [row._asdict() for row in found.table]
        names = {**policy.names(), "seed": policy.provenance.seed}
        models.append({"checkpoint": path, **names, "table": table})
        for name, content in run_sections(policy, labels, config, results):
            models[-1][name] = content
            results.update(**models[0])
    if len(models) > 1:
        results.update(models=models, comparison=comparison(paths, types, outcomes))
    results.update(status="finished")


def types_to_evaluate(choice: Any, policy: LearnedPolicy, unseen: Any = None) -> list[tuple[float, ...]]:
    """Player types to evaluate a policy at.

    Default are the labelled types and those that `unseen` adds.

    Args:
        choice: "default", or what `parse_types` takes.
        policy: the policy.
        unseen: see `unseen_types`.

    Raises:
        ValueError: none of these, or entries that are not one finite number per player.
    """
    if choice != "default":
        return parse_types(policy.game, choice, key="theta", also=("default",))
    return list(dict.fromkeys([*policy.types, *unseen_types(policy.game, unseen, "unseen")]))


def unseen_types(game: Game, choice: Any, key: str) -> list[tuple[float, ...]]:
    """Types that are evaluated beside the labelled ones: the chosen ones, or four at quarters of the type box.

    Args:
        game: the game.
        choice: what `parse_types` takes; None for the four.
        key: where the choice stands, for messages.
    """
    if choice is not None:
        return parse_types(game, choice, key=key) if choice else []
    lo, width = game.type_box.lo, game.type_box.hi - game.type_box.lo
    quarters = [[own, *[others] * (game.players - 1)] for own, others in QUARTERS]
    return game.validate_types([(lo + width * torch.tensor(row) / 4).tolist() for row in quarters])


QUARTERS = ((0, 1), (1, 1), (1, 3), (3, 4))
"""Places in the type box, of the first player and of the others, in quarters of its edges."""


def solve_tests(
    game: Game,
    types: Sequence[tuple[float, ...]],
    settings: DictConfig,
    cache: Path,
    workers: int | None,
    results: Results,
) -> list[Extremal]:
    """Labels of the test starts of every type, from the cache or solved."""
    labels, seconds = solve_starts(game, types, settings, cache, workers, float(settings.widen))
    results.time("test_labels", seconds)
    results.update(test_seed=settings.seed)
    return labels


class Outcome(NamedTuple):
    """What came of the episodes of a policy."""

    table: list[TypeRow]
    """Type by type."""
    played: list[Trajectory]
    """The episodes of every type."""
    collided: list[Tensor]
    """Whether it collides, start by start, one (safe starts,) per type."""


def evaluate_policy(
    policy: LearnedPolicy, labels: Sequence[Extremal], settings: DictConfig, results: Results
) -> Outcome:
    """Roll out from the starts of the labels, put the table into the results, keep some episodes and draw one."""
    found = assess(policy, labels, settings, results)
    write_json(results.path.parent / EPISODES, episodes(policy.game, found.played, labels, settings.clearance))
    conditions = {name: settings[name] for name in ("clearance", "dt", "widen", "noise", "delay")}
    results.update(**conditions, table=[row._asdict() for row in found.table], episodes=EPISODES)
    draw(policy, labels[0], results.path.parent / "rollout.png", settings.dt)
    return found


def assess(policy: LearnedPolicy, labels: Sequence[Extremal], settings: DictConfig, results: Results) -> Outcome:
    """Roll out from the starts of the labels."""
    began = time.perf_counter()
    disturbance = Disturbance(settings.noise, settings.delay, settings.seed)
    played = play(policy.game, policy, labels, settings.dt, disturbance)
    table = tabulate(policy.game, labels, played, policy.types, settings.clearance, policy.operator.field)
    safe = [classify(found, settings.clearance)[0] for found in labels]
    results.time("evaluation", time.perf_counter() - began)
    return Outcome(table, played, [collided(part)[mask] for part, mask in zip(played, safe, strict=True)])


def comparison(
    paths: Sequence[str], types: Sequence[tuple[float, ...]], outcomes: Sequence[Sequence[Tensor]]
) -> dict[str, Any]:
    """Every model against the first, over all types and type by type."""
    rows = []
    for path, other in zip(paths[1:], outcomes[1:], strict=True):
        pairs = zip(types, outcomes[0], other, strict=True)
        by_type = [{"theta": theta, **compare(first, second)._asdict()} for theta, first, second in pairs]
        whole = compare(torch.cat(list(outcomes[0])), torch.cat(list(other)))
        rows.append({"checkpoint": path, **whole._asdict(), "types": by_type})
    return {"reference": paths[0], "models": rows}


def draw(policy: LearnedPolicy, found: Extremal, path: Path, dt: float, episodes: int = 15) -> None:
    """Draw a typical episode from the first starts of a label set; without matplotlib, say so."""
    starts, theta = found.x[:episodes, 0].float(), found.theta[:episodes].float()
    played = rollout(policy.game, policy, starts, theta, dt)
    names = policy.names()
    try:
        rollout_picture(policy.game, played, theta, path, " / ".join(names.values()), typical(played))
    except PlotsMissingError as error:
        log.info("No picture: %s", error)


def check_evaluation(game: Game, settings: Episodes) -> None:
    """Raise ValueError for entries that make no evaluation of the game."""
    control_steps(game, settings.dt)
