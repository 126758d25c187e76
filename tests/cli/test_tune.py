"""A search over settings: what is asked for, which trials come of it, and how it goes on."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import optuna
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import TrialState

from hno.cli import launch, tune
from hno.cli.arguments import UsageError
from hno.cli.config import read
from hno.cli.perform import Task, perform
from hno.cli.pruning import Pruning
from hno.cli.results import PrunedError, Results
from hno.cli.resume import own_configuration
from hno.cli.search import Proposer, Search, judged, same_place, taken
from hno.cli.settings import TrainSettings
from hno.cli.space import space
from hno.cli.study import PROPOSERS, ByNumber, Trials, check_asked, opened
from hno.cli.tune import Searching
from hno.training.validation import ClosedLoopValidation, Score
from tests.cli.conftest import SMOKE, Command, refused

LR = "optimizer.lr=tag(log,interval(1e-4,1e-2))"
ONE = "objective=val/costate_error"


@pytest.mark.parametrize(
    ("word", "axis"),
    [
        ("++a.b=interval(1,10)", FloatDistribution(1, 10)),
        ("a.b=tag(log,interval(1e-4,1e-2))", FloatDistribution(1e-4, 1e-2, log=True)),
        ("a.b=int(interval(1,10))", IntDistribution(1, 10)),
        ("a.b=range(8,33,8)", IntDistribution(8, 32, step=8)),
        ("a.b=range(10,1,-3)", IntDistribution(4, 10, step=3)),
        ("a.b=range(0.5,1.5,0.25)", FloatDistribution(0.5, 1.25, step=0.25)),
        ("a.b=sno,hno", CategoricalDistribution(["sno", "hno"])),
        ("a.b=choice([1,2],'x,y')", CategoricalDistribution(["[1,2]", "x\\,y"])),
    ],
)
def test_axes_are_in_hydras_words(word: str, axis: object) -> None:
    found = space(["seed=1", word])
    assert (found.axes, found.fixed) == ({"a.b": axis}, ["seed=1"])
    key = word.partition("=")[0]
    assert space([*found.words({"a.b": 3}), "x=1,2"]).fixed == ["seed=1", f"{key}=3"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["seed=1"], "nothing to search"),
        (["x=range(3,3)"], "the range is empty"),
        (["x=interval(3,1)"], "cannot be searched"),
        (["x=tag(log,interval(0,1))"], "cannot be searched"),
        (["x=tag(lin,interval(0,1))"], "the only tag is log"),
        (["x=glob(*)"], "name its choices"),
        (["objective=a,b"], "the same for all trials"),
    ],
)
def test_what_is_no_axis_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        space(words)


def test_words_of_a_search_are_told_from_those_of_a_training() -> None:
    given = ["search.seed=3", "trials=7", "search=gp", "sampler=mixed", "pruner=median", "pruner.n_min_trials=2", LR]
    found, rest = taken(given)
    assert rest == ["sampler=mixed", LR]
    search = judged(found)
    assert (search.trials, search.search.name, search.search.seed) == (7, "gp", 3)
    assert search.pruner is not None
    assert search.pruner.options == {"n_min_trials": 2}
    assert judged(taken([*search.words()])[0]) == search


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trials=0"], "trials"),
        (["search.seed=x"], "search.seed"),
        (["search.gamma=[1]"], "must be a number"),
        (["study=mine"], "give storage="),
        (["storage=postgresql://host/db"], "study=<name>"),
        (["storage=postgresql://me:secret@host/db", "study=mine"], "pgpass"),
    ],
)
def test_a_search_that_makes_no_sense_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message) as error:
        judged(taken(words)[0])
    assert "secret" not in str(error.value)


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, float]]:
    """Trials are done in no time, and leave this list of their numbers and rates; their error is |lr - 0.003|.

    With hno they fail, and with a seed of 13 they are interrupted the first time.
    """
    made: list[tuple[int, float]] = []

    def fake(task: Task, settings: TrainSettings, folder: Path) -> Results | None:
        lr = float(settings.optimizer["lr"])
        stopped = settings.seed == 13 and not made
        made.append((int(folder.name.partition("_")[0]), lr))
        metrics = {"val/costate_error": abs(lr - 3e-3), "val/value_error": lr}
        results = Results(folder / "results.json", {**task.head(settings), "metrics": metrics})
        failed = settings.operator.name == "hno"
        status = "interrupted" if stopped else "failed" if failed else "finished"
        results.update(status=status, reason="told to" if failed else None)
        return None if failed or stopped else results

    monkeypatch.setattr(launch, "perform", fake)
    monkeypatch.setattr(tune, "check", lambda config: read(TrainSettings, own_configuration(config)))
    return made


Done = list[tuple[int, float]]


def study_of(folder: Path) -> dict[str, Any]:
    content = json.loads((folder / "study.json").read_text())
    assert isinstance(content, dict)
    return content


def test_a_search_goes_on_as_if_it_had_not_ended(command: Command, tmp_path: Path, done: Done) -> None:
    words = (*SMOKE, "operator=sno", LR, ONE, "search.n_startup_trials=1")
    first = command("tune", *words, "trials=1", "--to", str(tmp_path / "a"), folder="none")
    assert first.code == 0, first.text
    more = command("tune", f"sweep={tmp_path / 'a'}", "trials=3", folder="none")
    assert more.code == 0, more.text
    once = [*done]
    done.clear()
    assert command("tune", *words, "trials=3", "--to", str(tmp_path / "b"), folder="none").code == 0
    assert [number for number, _ in done] == [0, 1, 2]
    assert once == done, "the same seed, one process: the same trials"
    assert len({lr for _, lr in done}) == 3
    study = study_of(tmp_path / "a")
    errors = [abs(lr - 3e-3) for _, lr in done]
    assert [trial["values"] for trial in study["trials"]] == [[error] for error in errors]
    assert study["best"] == [errors.index(min(errors))]
    assert f"Best: trial {study['best'][0]}, val/costate_error" in more.text
    refused(command("train", f"sweep={tmp_path / 'a'}", folder="none"), "a sweep of hno tune, not of hno train")


def test_failures_are_failed_trials_and_the_others_count(command: Command, tmp_path: Path, done: Done) -> None:
    words = (*SMOKE, "operator=sno,hno", "optimizer.lr=interval(1e-3,1e-2)", "search=random", "trials=3")
    run = command("tune", *words, "objective=[val/costate_error,val/value_error]", "--to", str(tmp_path), folder="none")
    study = study_of(tmp_path)
    for trial in study["trials"]:
        failed = trial["params"]["operator"] == "hno"
        assert (trial["state"], trial["reason"]) == (("failed", "told to") if failed else ("finished", None))
    states = {trial["state"] for trial in study["trials"]}
    assert (run.code, states) == (0, {"finished", "failed"}), "the seed makes both"
    front = [trial["values"] for trial in study["trials"] if trial["number"] in study["best"]]
    assert front
    assert not any(all(a < b for a, b in zip(one, two, strict=True)) for one in front for two in front)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (
            ("operator=sno", "objective=[val/costate_error,val/what]"),
            "finished without val/what, which objective names",
        ),
        (("operator=sno", ONE, "trainer.print_every=0"), "trainer.print_every"),
    ],
)
def test_a_search_without_any_number_fails(
    command: Command, tmp_path: Path, done: Done, words: tuple[str, ...], reason: str
) -> None:
    run = command("tune", *SMOKE, *words, LR, "trials=1", "--to", str(tmp_path), folder="none")
    assert run.code == 1
    (trial,) = study_of(tmp_path)["trials"]
    assert trial["state"] == "failed"
    assert reason in trial["reason"]


def test_a_trial_that_was_stopped_goes_on(command: Command, tmp_path: Path, done: Done) -> None:
    words = (*SMOKE, "operator=sno", "seed=13", LR, ONE)
    command("tune", *words, "trials=2", "--to", str(tmp_path), folder="none")
    assert [trial["state"] for trial in study_of(tmp_path)["trials"]] == ["open"], "no further one has begun"
    assert command("tune", f"sweep={tmp_path}", folder="none").code == 0
    assert [number for number, _ in done] == [0, 0, 1]
    assert done[0] == done[1]
    assert [trial["state"] for trial in study_of(tmp_path)["trials"]] == ["finished"] * 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("seed=1",), "There is nothing to search"),
        (("operator=sno,nonsense",), "nonsense"),
        ((LR, "search=best"), "No search named 'best'"),
        ((LR, "search.nothing=1"), "No option named 'nothing'"),
        ((LR, "pruner=median", "objective=[val/costate_error,seconds/training]"), "pruner= takes one objective"),
        ((LR, "pruner=median", "objective=test/collision_rate"), "known while a run trains"),
        ((LR, "-m"), "takes no --multirun"),
        (("sweep=/nowhere",), "There is no search to go on with"),
    ],
)
def test_what_makes_no_search_is_refused_before_any_work(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    run = command("tune", *SMOKE, *words, folder="none")
    refused(run, message)
    assert (run.code, list(tmp_path.iterdir())) == (2, [])


def test_without_optuna_one_sentence_says_how_to_install_it(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "optuna" else find(name))
    run = command("tune", *SMOKE, LR, folder="none")
    said = "hno tune needs a package that is not installed: pip install 'hno[tune]'."
    assert (run.code, run.text.strip()) == (2, said)


def test_a_storage_that_cannot_be_used_is_named(command: Command, tmp_path: Path) -> None:
    words = (f"storage=sqlite:///{tmp_path}/no/where.db", "study=mine", "--to", str(tmp_path / "run"))
    refused(command("tune", *SMOKE, LR, *words, folder="none"), "The study cannot be kept in", "unable to open")


def test_a_folder_opens_no_database_unless_the_command_line_names_it(command: Command, tmp_path: Path) -> None:
    """A folder may be somebody else's."""
    place = {"storage": f"sqlite:///{tmp_path}/precious.db", "study": "ours"}
    folder = tmp_path / "search"
    folder.mkdir()
    (folder / "study.json").write_text(json.dumps({"mark": "m", "search": {"trials": 7, **place}}))
    other = f"storage=sqlite:///{tmp_path}/other.db"
    for words in ((), ("study=ours",), (other, "study=ours"), (f"storage={place['storage']}", "study=mine")):
        run = command("tune", f"sweep={folder}", *words, folder="none")
        refused(run, "give it again: storage=", "study=ours")
        assert run.code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["search"]
    again = Searching(judged({**same_place({"trials": 7, **place}, place), **place}))
    assert again.search.trials == 7
    assert again.place == [f"{key}={value}" for key, value in place.items()]


@pytest.mark.parametrize("content", [{}, {"mark": "m"}, {"mark": 1, "search": {}}, {"mark": "m", "search": {"x": 1}}])
def test_a_file_that_is_of_no_search_is_refused(command: Command, tmp_path: Path, content: dict[str, Any]) -> None:
    (tmp_path / "study.json").write_text(json.dumps(content))
    assert command("tune", f"sweep={tmp_path}", folder="none").code == 2


@pytest.mark.parametrize("name", [*PROPOSERS])
def test_what_is_proposed_follows_from_the_seed_the_number_and_the_ends_of_others(name: str) -> None:
    def xs(count: int, study: optuna.Study) -> list[float]:
        for _ in range(count):
            trial = study.ask({"x": FloatDistribution(0, 1)})
            study.tell(trial, (trial.params["x"] - 0.3) ** 2)
        return [trial.params["x"] for trial in study.trials]

    def sampler(seed: int) -> ByNumber:
        return ByNumber(Proposer(name=name, seed=seed))

    study = optuna.create_study(sampler=sampler(1))
    xs(6, study)
    study.sampler = sampler(1)  # as in a process that goes on
    assert len(set(xs(6, study))) == 12
    assert xs(0, study) == xs(12, optuna.create_study(sampler=sampler(1)))
    assert xs(1, optuna.create_study(sampler=sampler(2))) != xs(0, study)[:1]


def trials(search: Search, folder: Path, mark: str) -> Trials:
    study = opened(search, folder, 1)
    return Trials(study, search, folder, ["val/costate_error"], {"x": FloatDistribution(0, 1)}, mark)


def test_two_processes_share_a_study_and_repeat_no_trial(tmp_path: Path) -> None:
    search = judged(taken([f"storage=sqlite:///{tmp_path}/study.db", "study=ours", "trials=6", "search=random"])[0])
    one, two = (trials(search, tmp_path / mark, mark) for mark in ("one", "two"))
    check_asked(one.study, {"game": "drone"})
    check_asked(two.study, {"game": "drone"})
    with pytest.raises(UsageError, match="game: drone, now not given"):
        check_asked(two.study, {})
    proposed = [trial for turn in (one, two, two, one) for trial in turn.propose(2)]
    assert [trial.number for trial in proposed] == [*range(6)], "six of the whole study"
    assert len({trial.params["x"] for trial in proposed}) == 6
    assert [trial.number for trial in one.left()] == [0, 1]
    assert [trial.number for trial in two.left()] == [2, 3, 4, 5]


def test_a_hopeless_training_is_ended(tmp_path: Path) -> None:
    search = judged(taken(["pruner=median", "pruner.n_startup_trials=1"])[0])
    mine = trials(search, tmp_path, "mine")
    for value in (0.1, 0.2, 0.9):
        trial = mine.study.ask(dict(mine.axes))
        if value < 0.5:
            trial.report(value, 5)
            mine.study.tell(trial, value)
    watch = ClosedLoopValidation(tmp_path, 5)
    watch.best = Score(0.5, 0.1)
    trainer: Any = SimpleNamespace(
        sanity_checking=False, global_step=5, callback_metrics={"val/costate_error": 0.9}, callbacks=[watch]
    )
    study = opened(search, tmp_path)
    with pytest.raises(PrunedError, match=r"stopped at step 5, where val/costate_error was 0\.9"):
        Pruning(study, 2, "val/costate_error").on_validation_end(trainer, Any)
    with pytest.raises(PrunedError, match=r"best/collision_rate was 0\.5"):
        Pruning(study, 2, "best/collision_rate").on_validation_end(trainer, Any)
    with pytest.raises(ValueError, match=r"needs val/what at every validation; this run has best/"):
        Pruning(study, 2, "val/what").on_validation_end(trainer, Any)
    assert mine.end(2, {"status": "pruned"})
    assert mine.study.trials[2].state == TrialState.PRUNED
    assert mine.study.trials[2].intermediate_values == {5: 0.9}


def test_a_pruned_run_has_neither_failed_nor_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def hopeless(settings: object, results: Results) -> None:
        raise PrunedError("stopped at step 5")

    results = perform(Task("train", Any, lambda settings: {}, hopeless), object(), tmp_path)
    assert results is not None
    assert (results.content["status"], results.content["reason"]) == ("pruned", "stopped at step 5")


def test_a_training_tells_its_study_how_it_stands(command: Command, tmp_path: Path) -> None:
    words = (*SMOKE, "trainer.max_steps=2", "trainer.validate_every=1", "logger=csv", LR, ONE)
    run = command("tune", *words, "trials=1", "pruner=median", "--to", str(tmp_path), folder="none")
    assert run.code == 0, run.text
    study = optuna.load_study(study_name="hno", storage=f"sqlite:///{tmp_path}/study.db")
    told = study.trials[0].intermediate_values
    assert [*told] == [1, 2]
    assert told[2] == study.trials[0].values[0]


@pytest.mark.slow
def test_jobs_of_a_search_run_side_by_side_and_are_pruned(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (*SMOKE, "operator=sno", "logger=csv", "trainer.max_steps=40", "optimizer.lr=1e-2,1e-6", ONE, "trials=8")
    prune = ("pruner=median", "pruner.n_startup_trials=1", "search=random")
    run = command("tune", *words, *prune, "launcher=joblib", "launcher.n_jobs=2", "--to", str(tmp_path), folder="none")
    assert run.code == 0, run.text
    states = {trial["params"]["optimizer.lr"]: set() for trial in study_of(tmp_path)["trials"]}  # type: ignore[var-annotated]
    for trial in study_of(tmp_path)["trials"]:
        states[trial["params"]["optimizer.lr"]].add(trial["state"])
    assert "finished" in states["0.01"]
    assert "pruned" in states["1e-06"]
