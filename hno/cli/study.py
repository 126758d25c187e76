"""A study of Optuna: who proposes its trials, where they are kept, and what is left of them for readers."""

from __future__ import annotations

import inspect
import secrets
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import optuna
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from hno.cli import again
from hno.cli.arguments import UsageError
from hno.cli.objective import present
from hno.cli.results import write_json
from hno.cli.search import DATABASE, STUDY, Named, Proposer, Search
from hno.registry import unknown_name

PROPOSERS = {"tpe": "TPESampler", "random": "RandomSampler", "nsga2": "NSGAIISampler", "gp": "GPSampler"}
"""Optuna's samplers that propose trials, by our names."""
PRUNERS = {"median": "MedianPruner", "halving": "SuccessiveHalvingPruner"}
ENDS = {"finished": TrialState.COMPLETE, "pruned": TrialState.PRUNED, "failed": TrialState.FAIL}
"""What becomes of the trial of a job, by the status in its results; any other is not at its end."""
STATES = {**{state: name for name, state in ENDS.items()}, TrialState.RUNNING: "open", TrialState.WAITING: "open"}
OWNER, ASKED = "sweep", "asked"
"""Attributes: of a trial the folder whose process does it, by its mark; of a study what was asked for."""
ENOUGH = 8
"""Finished trials from which on it is said what mattered."""


def made(kind: str, chosen: Named, known: Mapping[str, str], **given: Any) -> Any:
    """A sampler or a pruner of Optuna's by our name for it.

    Raises:
        UsageError: no such name, or an option that it does not have.
    """
    if chosen.name not in known:
        raise UsageError(f"{kind}={chosen.name}: {unknown_name(kind, chosen.name, list(known))}")
    cls = getattr(optuna.pruners if known is PRUNERS else optuna.samplers, known[chosen.name])
    options = [name for name in inspect.signature(cls).parameters if name not in given]
    for name in chosen.options:
        if name not in options:
            raise UsageError(f"{kind}={chosen.name}: {unknown_name('option', name, options)}")
    try:
        with warnings.catch_warnings(action="ignore"):  # that something is experimental
            return cls(**chosen.options, **given)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{kind}={chosen.name}: {error}") from error


class ByNumber(BaseSampler):
    """A sampler whose draws follow from the seed and the number of the trial, wherever and whenever it is proposed.

    Args:
        chosen: the sampler, its options and the seed.
    """

    def __init__(self, chosen: Proposer) -> None:
        self.chosen, self.number = chosen, 0
        self.own: BaseSampler = self._made(0)

    def _made(self, number: int) -> Any:
        return made("search", self.chosen, PROPOSERS, seed=seed_of(self.chosen.seed, number))

    def of(self, trial: FrozenTrial) -> BaseSampler:
        """The sampler of a trial."""
        if trial.number != self.number:
            self.number, self.own = trial.number, self._made(trial.number)
        return self.own

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """Axes that are drawn together."""
        return self.of(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Draw these axes."""
        return self.of(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """Draw one axis."""
        return self.of(trial).sample_independent(study, trial, param_name, param_distribution)

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        """Optuna's hook."""
        self.of(trial).before_trial(study, trial)

    def after_trial(self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None) -> None:
        """Optuna's hook."""
        self.of(trial).after_trial(study, trial, state, values)


def seed_of(seed: int, number: int) -> int:
    """The seed of a trial."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def url(search: Search, folder: Path) -> str:
    """Where the trials are kept; a file in the folder of the search by default."""
    return search.storage or f"sqlite:///{folder.absolute() / DATABASE}"


def opened(search: Search, folder: Path, objectives: int | None = None) -> Study:
    """The study, for the process that proposes its trials, or for one of its jobs.

    Args:
        search: names it.
        folder: of the search.
        objectives: how many it has, all of which are minimised; None for a study that is there.

    Raises:
        UsageError: the storage cannot be used.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    place = url(search, folder)
    pruner = made("pruner", search.pruner, PRUNERS) if search.pruner else optuna.pruners.NopPruner()
    try:
        with warnings.catch_warnings(action="ignore"):
            waits = {"connect_args": {"timeout": 60}} if place.startswith("sqlite") else {"pool_pre_ping": True}
            storage = optuna.storages.RDBStorage(place, engine_kwargs=waits)
            if objectives is None:
                return optuna.load_study(study_name=search.study, storage=storage, pruner=pruner)
            return optuna.create_study(
                study_name=search.study, storage=storage, sampler=ByNumber(search.search), pruner=pruner,
                directions=["minimize"] * objectives, load_if_exists=True,
            )  # fmt: skip
    except Exception as error:  # of whatever database
        said = " ".join(str(error.__cause__ or error).split("\n(Background")[0].split())
        raise UsageError(f"The study cannot be kept in {place}: {type(error).__name__}: {said}") from error


def check_asked(study: Study, asked: Mapping[str, str]) -> None:
    """Refuse to go on with a study of other words; a new one keeps them.

    Raises:
        UsageError: with the words that differ.
    """
    was = study.user_attrs.get(ASKED)
    if was is None and not study.get_trials(deepcopy=False):
        study.set_user_attr(ASKED, dict(asked))
    elif differing := again.differing(was or {}, asked):
        raise UsageError(f"The study {study.study_name} is of another search:\n{differing}\nChoose another study=.")


class Trials(NamedTuple):
    """The trials of a study that the processes of one folder do."""

    study: Study
    search: Search
    folder: Path
    objectives: list[str]
    axes: Mapping[str, BaseDistribution]
    mark: str
    """By which those of this folder are known."""

    def left(self) -> list[FrozenTrial]:
        """Those of this folder that have no end: whoever did them was stopped, since the folder is ours now."""
        found = self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
        return [trial for trial in found if trial.user_attrs.get(OWNER) == self.mark]

    def propose(self, most: int) -> list[FrozenTrial]:
        """New trials, until the study has as many as it was to have."""
        room = self.search.trials - len(self.study.get_trials(deepcopy=False))
        numbers = []
        for _ in range(min(room, most)):
            with warnings.catch_warnings(action="ignore"):
                trial = self.study.ask(dict(self.axes))
            trial.set_user_attr(OWNER, self.mark)
            numbers.append(trial.number)
        return [trial for trial in self.study.get_trials(deepcopy=False) if trial.number in numbers]

    def end(self, number: int, found: Mapping[str, Any]) -> bool:
        """Tell the study what became of a trial, from the results of its job.

        Returns:
            Whether it has come to an end; otherwise it goes on when the search does.
        """
        state = ENDS.get(str(found.get("status")))
        if state is None:
            return False
        values = present(self.objectives, found) if state == TrialState.COMPLETE else {}
        if state == TrialState.COMPLETE and len(values) < len(self.objectives):
            state, values = TrialState.FAIL, {}
        self.study.tell(number, [values[name] for name in self.objectives] if values else None, state)
        return True

    def write(self, command: Sequence[str]) -> dict[str, Any]:
        """Leave what there is for readers, and return it.

        Args:
            command: the words of the search, as the command line takes them.
        """
        trials = self.study.get_trials(deepcopy=False)
        finished = [trial for trial in trials if trial.state == TrialState.COMPLETE]
        best = ([self.study.best_trial] if len(self.objectives) == 1 else self.study.best_trials) if finished else []
        content = {
            "mark": self.mark, "search": self.search.model_dump(), "words": list(command),
            "objectives": self.objectives, "axes": list(self.axes), "best": [trial.number for trial in best],
            "importance": self._importance(len(finished)), "trials": [self._record(trial) for trial in trials],
        }  # fmt: skip
        write_json(self.folder / STUDY, content)
        return content

    def _record(self, trial: FrozenTrial) -> dict[str, Any]:
        ours = trial.user_attrs.get(OWNER) == self.mark
        job = next(iter(self.folder.glob(f"{trial.number}_*")), None) if ours else None
        found = again.results(job) if job and trial.state in (TrialState.FAIL, TrialState.PRUNED) else {}
        reason = found.get("reason")
        if trial.state == TrialState.FAIL and found.get("status") == "finished":
            missing = [name for name in self.objectives if name not in present(self.objectives, found)]
            reason = f"finished without {', '.join(missing)}, which objective names"
        values = trial.values if trial.state == TrialState.COMPLETE else None
        return {
            "number": trial.number, "state": STATES[trial.state], "values": values, "params": trial.params,
            "job": job and job.name, "reason": reason,
        }  # fmt: skip

    def _importance(self, finished: int) -> dict[str, float] | None:
        """The share of each axis in how much the first objective differs; None where too little is known."""
        if finished < ENOUGH or len(self.axes) < 2:
            return None
        several = len(self.objectives) > 1
        with warnings.catch_warnings(action="ignore"), suppress(ValueError, RuntimeError):
            return optuna.importance.get_param_importances(
                self.study, evaluator=optuna.importance.PedAnovaImportanceEvaluator(),
                target=(lambda trial: float(trial.values[0])) if several else None,
            )  # fmt: skip
        return None


def new_mark() -> str:
    """A mark for a folder."""
    return secrets.token_hex(8)
