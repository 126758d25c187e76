"""`hno tune`: a sweep whose jobs are proposed by Optuna, one after the other or several at once."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import hydra
import joblib
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf

from hno.cli import again, launch
from hno.cli.arguments import Arguments, UsageError, as_path, quoted
from hno.cli.build import check
from hno.cli.config import compose
from hno.cli.confs import config_dir
from hno.cli.objective import named
from hno.cli.perform import Task
from hno.cli.results import Results
from hno.cli.search import DATABASE, STUDY, Search, before, judged, same_place, taken
from hno.cli.sweep import TRIAL, Job
from hno.cli.train import head, train
from hno.evaluation.format import counted, significant
from hno.report.runs import read_json

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

    from hno.cli.space import Space
    from hno.cli.study import Trials


def run(given: Arguments) -> int:
    """`hno tune`."""
    if importlib.util.find_spec("optuna") is None:
        raise UsageError("hno tune needs a package that is not installed: pip install 'hno[tune]'.")
    words, rest = taken(given.overrides)
    folder = _folder(rest)
    if folder is not None:
        words = {**same_place(before(folder)["search"], words), **words}
    searching = Searching(judged(words))
    task = Task("train", check, head, partial(work, searching.search), search=searching)
    return launch.run(task, given._replace(overrides=rest, flags={**given.flags, "--multirun": ""}))


def _folder(words: Sequence[str]) -> Path | None:
    """The folder of a search that goes on."""
    places = [word.partition("=")[2] for word in words if word.lstrip("+").startswith("sweep=")]
    place = OverridesParser.create().parse_override(f"sweep={as_path(places[-1])}").value() if places else None
    return Path(str(place)) if place else None


def work(search: Search, settings: Any, results: Results) -> None:
    """One trial: a training, which may be pruned."""
    from hno.cli.pruning import pruning

    number, folder = Job.current().number, Path(HydraConfig.get().sweep.dir)
    train(settings, results, pruning(search, folder, number, named(settings.objective)[0]))


class Searching(NamedTuple):
    """How jobs of a multirun are chosen by a search."""

    search: Search
    command: str = "tune"

    @property
    def place(self) -> list[str]:
        """The words that say where trials are kept, unless that is the folder of the search."""
        return [word for word in self.search.words() if word.startswith(("storage=", "study="))]

    def check(self, words: Sequence[str], dry: bool) -> bool:
        """Refuse a search that makes no sense, before anything is written; a dry one is printed.

        Args:
            words: of the command line, as Hydra takes them.
            dry: whether to print it.

        Returns:
            Whether that was all.

        Raises:
            UsageError: with the reason.
        """
        from hno.cli.pruning import known_while_training
        from hno.cli.space import said, space
        from hno.cli.study import PRUNERS, ByNumber, made

        found = space([*_params(), *words])
        ByNumber(self.search.search)
        for corner in found.corners():
            config = compose("train", corner)
        objectives = named(OmegaConf.to_container(config)["objective"])  # type: ignore[index, call-overload]
        if self.search.pruner is not None:
            made("pruner", self.search.pruner, PRUNERS)
            if len(objectives) > 1:
                raise UsageError("pruner= takes one objective: Optuna prunes no study of several.")
            if not known_while_training(objectives[0]):
                raise UsageError(
                    f"pruner= needs an objective that is known while a run trains: best/collision_rate, "
                    f"best/excess_cost or one that begins with val/ or loss/; got {objectives[0]}."
                )
        if dry:
            axes = [f"  {name}: {said(axis)}" for name, axis in found.axes.items()]
            heading = f"{counted(self.search.trials, 'trial')} by {self.search.search.name} of"
            print("\n".join([heading, *axes, f"to minimise {', '.join(objectives)}"]))
        return dry

    def run(self, name: str, job: Callable[[DictConfig], Any], words: Sequence[str]) -> None:
        """Launch trials until the study has enough of them.

        Args:
            name: the root configuration.
            job: what is done with each configuration.
            words: as Hydra takes them.
        """
        from hno.cli.space import space

        with _launching(name, job, words) as (launcher, config):
            folder = Path(config.hydra.sweep.dir)
            found = space([*_params(), *config.hydra.overrides.task])
            trials = _trials(self.search, folder, found, named(config.objective))
            _record(config, folder, self.command)
            content, launched = trials.write([*self.search.words()]), 0
            batch, most = trials.left(), self.search.at_once or _at_once(config)
            while batch := batch or trials.propose(most):
                jobs = [_words(found, trial, config) for trial in batch]
                returned = launcher.launch(jobs, initial_job_idx=launched)
                ended = [
                    trials.end(trial.number, again.results(Path(back.hydra_cfg.hydra.runtime.output_dir)))
                    for trial, back in zip(batch, returned, strict=True)
                ]
                content, launched, batch = trials.write([*self.search.words()]), launched + len(batch), []
                if not any(ended):
                    break  # they were told to stop
        _show(content)

    def succeeded(self, folder: Path) -> bool:
        """Whether any trial of the study has numbers."""
        return bool(read_json(folder / STUDY)["best"])


def _params() -> list[str]:
    """What an experiment of the composed configuration sweeps."""
    return [f"{key}={value}" for key, value in (HydraConfig.get().sweeper.get("params") or {}).items()]


@contextmanager
def _launching(name: str, job: Callable[[DictConfig], Any], words: Sequence[str]) -> Iterator[tuple[Any, DictConfig]]:
    """The launcher that the command line chooses, and the configuration that its jobs vary."""
    from hydra._internal.callbacks import Callbacks  # where hydra's own programs have theirs from

    with hydra.initialize_config_dir(str(config_dir()), version_base="1.3", job_name=name):
        made = GlobalHydra.instance().hydra
        assert made is not None
        own = [*(word for word in words if not word.startswith("--")), "hydra.mode=MULTIRUN"]
        config = made.compose_config(name, own, RunMode.MULTIRUN, with_log_configuration=True)
        HydraConfig.instance().set_config(config)
        context = HydraContext(config_loader=made.config_loader, callbacks=Callbacks(config))
        yield Plugins.instance().instantiate_launcher(context, job, config), config


def _trials(search: Search, folder: Path, found: Space, objectives: list[str]) -> Trials:
    from hno.cli.study import Trials, check_asked, new_mark, opened

    there = (folder / STUDY).exists()
    if there and search.storage is None and not (folder / DATABASE).exists():
        raise UsageError(
            f"{folder / DATABASE}, which holds the trials, is gone. Begin a search of its own, without sweep=."
        )
    study = opened(search, folder, len(objectives))
    check_asked(study, {**again.asked(found.fixed), **{name: repr(axis) for name, axis in found.axes.items()}})
    mark = str(before(folder)["mark"]) if there else new_mark()
    return Trials(study, search, folder, objectives, found.axes, mark)


def _record(config: DictConfig, folder: Path, command: str) -> None:
    """What Hydra leaves of a sweep, under the command that goes on with it."""
    kept = config.copy()
    OmegaConf.set_readonly(kept.hydra.job, False)
    kept.hydra.job.name = command
    OmegaConf.save(kept, folder / again.RECORD)


def _at_once(config: DictConfig) -> int:
    workers = config.hydra.launcher.get("n_jobs")
    return 1 if workers is None else int(joblib.effective_n_jobs(workers))


def _words(found: Space, trial: FrozenTrial, config: DictConfig) -> list[str]:
    """The command line of a trial's job, whose folder begins with its number."""
    subdir = str(OmegaConf.to_container(config.hydra.sweep)["subdir"])  # type: ignore[index, call-overload]
    place = subdir.replace("${hydra.job.num}", str(trial.number))
    own = [f"+hydra.job.env_set.{TRIAL}='{trial.number}'", f"hydra.sweep.subdir={quoted(place)}"]
    return [*found.words(trial.params), *own]


def _show(content: dict[str, Any]) -> None:
    """Say how many trials ended how, and which are best."""
    states = [trial["state"] for trial in content["trials"]]
    said = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    print(f"{counted(len(states), 'trial')}: {said}")
    for number in content["best"]:
        trial = next(one for one in content["trials"] if one["number"] == number)
        pairs = zip(content["objectives"], trial["values"], strict=True)
        numbers = ", ".join(f"{name} {significant(value)}" for name, value in pairs)
        print(f"Best: trial {number}, {numbers}: {' '.join(f'{key}={one}' for key, one in trial['params'].items())}")
