from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import hno
from hno.cli.build import build, record_of
from hno.cli.calls import train_settings
from hno.data import many
from hno.data.exchange import drawn_by, write_own
from hno.data.store import write_labels
from hno.evaluation.metrics import upper_bound
from hno.games import make
from hno.operators import make_operator
from hno.training.checkpoint import KEY, Draw, Provenance, load_policy, record
from hno.training.saving import seal
from tests.cli.conftest import Command, Outcome, refused
from tests.fakes import fake_labels, fake_solve, small_architecture

DRAWS: list[Draw] = [("labels and held-out labels", "train", 3), ("validation and stopping", "validation", 8)]


def saved(folder: Path, draws: list[Draw] | None = DRAWS, method: str = "hno") -> Path:
    """A narrow-road operator with random weights, and what was drawn to make it."""
    torch.manual_seed(0)
    game, architecture = make("narrow_road"), small_architecture()
    weights = make_operator(game, architecture).state_dict()
    origin = Provenance(method, [(1.0, 1.0)], 3, "any", draws)
    folder.mkdir(exist_ok=True)
    content = {"state_dict": {f"operator.{name}": weight for name, weight in weights.items()}}
    (folder / "best.ckpt").write_bytes(seal(content | record(game, architecture, origin)))
    return folder


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    return saved(tmp_path / "model")


@pytest.fixture
def certify(command: Command, run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Outcome]:
    """`hno certify` of few and short episodes, with a solver that answers at once."""
    monkeypatch.setattr(many, "solve", fake_solve)

    def run(*words: str, place: Path | None = None) -> Outcome:
        return command("certify", str(place or run_folder), "tests=40", "dt=0.1", "workers=1", "equilibria=5", *words)

    return run


def content_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "certificate.json").read_text())


def test_certificate_states_bounds_and_what_they_rest_on(certify: Callable[..., Outcome], run_folder: Path) -> None:
    run = certify("beta=0.01")
    found = content_of(run_folder)
    assert run.code == 0
    assert found["every"]["bound"] == upper_bound(found["every"]["collisions"], 40, 0.01)
    assert found["safe"]["solved"] == 5
    assert found["safe"]["safe"] == 5
    assert (found["settings"]["seed"], found["settings"]["beta"], found["settings"]["tests"]) == (314159, 0.01, 40)
    assert found["sha256"] == hashlib.sha256((run_folder / "best.ckpt").read_bytes()).hexdigest()
    assert found["draws"] == [list(draw) for draw in DRAWS]
    for words in ("N = 40 tests, seed 314159, beta = 0.01", "type box", "all 2 players", "(train 3)", "(validation 8)"):
        assert words in run.text
    assert run.text.splitlines()[-1] == str(run_folder / "certificate.json")


def test_the_same_certificate_twice_is_one(certify: Callable[..., Outcome], run_folder: Path) -> None:
    certify(), certify()
    assert content_of(run_folder)["earlier"] == []
    run = certify("seed=11")
    assert [one["settings"]["seed"] for one in content_of(run_folder)["earlier"]] == [314159]
    assert "beta is 2 times as large" in run.text


@pytest.mark.parametrize("seed", [3, 8])
def test_a_seed_that_made_the_model_is_refused(certify: Callable[..., Outcome], run_folder: Path, seed: int) -> None:
    run = certify(f"seed={seed}")
    refused(run, f"seed={seed} made the model", "3, 8" if seed else "")
    assert run.code == 2
    assert not (run_folder / "certificate.json").exists()


def test_the_seed_of_the_run_s_own_evaluation_is_refused(certify: Callable[..., Outcome], run_folder: Path) -> None:
    (run_folder / "results.json").write_text(json.dumps({"test_seed": 1000}))
    refused(certify("seed=1000"), "seed=1000 made the model: evaluation (split 'test')")
    assert certify().code == 0


def test_a_model_that_does_not_list_its_draws_is_refused(certify: Callable[..., Outcome], tmp_path: Path) -> None:
    refused(certify(place=saved(tmp_path / "old", None)), "does not list the starts")


@pytest.mark.parametrize(
    ("word", "fragments"),
    [
        ("tests=0", ["tests", "greater than or equal to 1", "0"]),
        ("beta=0", ["beta", "greater than 0"]),
        ("beta=1", ["beta", "less than 1"]),
        ("beta=nan", ["beta", "finite"]),
        ("target=1.5", ["target", "less than 1"]),
        ("theta=nowhere", ["theta must be one of box", "nowhere"]),
        ("theta=[[1,nan]]", ["theta"]),
        ("dt=0.7", ["dt must be", "divides the horizon"]),
        ("expected_game=drone", ["narrow_road", "expected 'drone'"]),
        ("test=5", ["test does not exist", "tests"]),
        ("seed=-1", ["seed"]),
    ],
)
def test_bad_settings_are_one_clear_error(
    certify: Callable[..., Outcome], run_folder: Path, word: str, fragments: list[str]
) -> None:
    run = certify(word)
    refused(run, *fragments)
    assert run.code == 2
    assert len(run.text.strip().splitlines()) == 1
    assert not (run_folder / "certificate.json").exists()


def test_a_place_without_a_model_and_a_foreign_certificate_are_refused(
    certify: Callable[..., Outcome], run_folder: Path, tmp_path: Path
) -> None:
    refused(certify(place=tmp_path / "nowhere"), "There is no checkpoint")
    (run_folder / "certificate.json").write_text("{}")
    refused(certify(), "is no certificate of hno", "move it away")
    assert (run_folder / "certificate.json").read_text() == "{}"


@pytest.mark.parametrize("text", ["", "[]", "{"])
def test_results_of_an_evaluation_that_cannot_be_read_are_refused(
    certify: Callable[..., Outcome], run_folder: Path, text: str
) -> None:
    """They may say that the seed chose the model."""
    (run_folder / "results.json").write_text(text)
    run = certify()
    refused(run, "results.json")
    assert run.code == 2
    assert not (run_folder / "certificate.json").exists()


def test_types_may_be_listed(certify: Callable[..., Outcome], run_folder: Path) -> None:
    run = certify("theta=1,1;2.5,4", "equilibria=0")
    assert "2 types, each as likely" in run.text
    assert content_of(run_folder)["safe"] is None


def test_python_certifies_as_the_command_does(run_folder: Path, clean_globals: None) -> None:
    settings = {"tests": 30, "dt": 0.1, "equilibria": 0}
    assert hno.certify(run_folder, settings) == content_of(run_folder)
    with pytest.raises(ValueError, match="seed=3 made the model"):
        hno.certify(run_folder, settings | {"seed": 3})


@pytest.mark.slow
def test_an_exported_controller_has_the_certificate_of_its_checkpoint(run_folder: Path, clean_globals: None) -> None:
    settings = {"tests": 30, "dt": 0.1, "equilibria": 0}
    exported = load_policy(run_folder).export("numpy", run_folder / "exported")
    assert hno.certify(exported, settings)["every"] == hno.certify(run_folder, settings)["every"]
    assert content_of(exported)["draws"] == [list(draw) for draw in DRAWS]
    with pytest.raises(ValueError, match="seed=3 made the model"):
        hno.certify(exported, settings | {"seed": 3})


def test_a_training_lists_what_it_draws(tmp_path: Path) -> None:
    game = make("narrow_road")
    own, brought = tmp_path / "own.safetensors", tmp_path / "brought.safetensors"
    write_own(brought, game, fake_labels(game), "a paper")
    identity = {"game": "NarrowRoad", "fingerprint": game.fingerprint()}
    write_labels(own, fake_labels(game), {**identity, "request": {"seed": 77, "split": "test"}})
    assert drawn_by(own) == ("test", 77)
    files = f"data.files=[{own},{brought}]"
    plain = ["experiment=smoke", "seed=5"]
    cases = {
        (): [("validation and stopping", "train", 5)],
        ("validation=grid5", "validation.seed=9"): [("validation and stopping", "validation", 9)],
        ("data.adaptive.rounds=1",): [("added labels", "adaptive", 5), ("validation and stopping", "train", 5)],
        (files,): [
            ("labels of own.safetensors", "test", 77),
            ("labels of brought.safetensors", "a paper", None),
            ("validation and stopping", "train", 5),
        ],
    }  # fmt: skip
    for words, expected in cases.items():
        settings = train_settings([*plain, *words])
        found = record_of(settings, build(settings))[KEY]["provenance"]["draws"]
        assert found == [("batches", "batches", 5), ("labels and held-out labels", "train", 5), *expected]
