from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from hno.cli.main import main
from hno.data import labels as label_data
from hno.data.labels import Request, label_set
from hno.data.shards import SHARD
from hno.games import Game, make
from hno.pontryagin.solve import Solver
from hno.processes import Interrupted
from hno.types import Extremal, Status
from tests.data import conftest
from tests.data.conftest import Asked
from tests.fakes import fake_solve

asked = conftest.asked
"""The fixture of the tests of labels."""
WANTED = {"game": "narrow_road", "theta": "1,1;2.5,4", "n": "5", "workers": "1"}


class Outcome(NamedTuple):
    code: int
    out: str
    err: str


Generate = Callable[..., Outcome]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "cache"


@pytest.fixture
def generate(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path, asked: Asked
) -> Generate:
    """Run the command in this process with a solver that answers at once; None leaves an option out."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "argv", ["hno"])

    def run(*words: str, **changes: str | None) -> Outcome:
        options = {**WANTED, "cache": str(folder), **changes}
        code = main(["labels", *(f"{name}={value}" for name, value in options.items() if value is not None), *words])
        return Outcome(code, *capsys.readouterr())

    return run


def sets(folder: Path, **changes: object) -> list[Path]:
    usual = {"all_equilibria": changes.get("split", "train") == "train"}  # what trainings and evaluations read
    requests = [Request(theta, 5, 0, "train")._replace(**usual | changes) for theta in ((1.0, 1.0), (2.5, 4.0))]
    return [label_set(make("narrow_road"), request, folder).folder for request in requests]


def cells(printed: str, theta: str) -> list[str]:
    """The cells of a type's line in the table."""
    lines = [re.split(r"\s{2,}", line.strip()) for line in printed.splitlines()]
    return next((line for line in lines if line[0] == theta), [])


def test_table_has_a_line_per_type(generate: Generate, folder: Path) -> None:
    run = generate()
    assert (run.code, run.err) == (0, "")
    for theta in ("1, 1", "2.5, 4"):
        name, starts, converged, collisions, safe, *worst = cells(run.out, theta)
        assert (name, starts, converged, collisions, safe) == (theta, "5", "5", "0.0%", "5")
        assert all(float(number) < 1e-4 for number in worst)
    assert "10 of 10: 10 converged, 0 failed" in run.out


def test_folders_of_the_sets_are_the_last_lines(generate: Generate, folder: Path) -> None:
    run = generate()
    assert run.out.splitlines()[-2:] == [str(path) for path in sets(folder)]
    assert sorted(path.parent for path in folder.rglob("shard-*")) == sorted(sets(folder))


def test_the_same_command_again_solves_nothing(generate: Generate, asked: Asked) -> None:
    first, again = generate(), generate()
    assert asked.total() == 10
    assert again.code == 0
    assert cells(again.out, "2.5, 4") == cells(first.out, "2.5, 4")


def test_more_starts_extend_a_set(generate: Generate, asked: Asked) -> None:
    generate()
    run = generate(n="8")
    assert asked.total() == 16
    assert cells(run.out, "1, 1")[1] == "8"


@pytest.mark.parametrize(
    ("option", "value"), [("seed", "3"), ("split", "test"), ("widen", "2")], ids=["seed", "split", "widen"]
)
def test_options_are_part_of_the_request(generate: Generate, folder: Path, option: str, value: str) -> None:
    run = generate(**{option: value})
    wanted = sets(folder, **{option: value if option == "split" else int(value)})
    assert [Path(line).name.rsplit("_", 1)[0] for line in run.out.splitlines()[-2:]] == [
        path.name.rsplit("_", 1)[0] for path in wanted
    ]
    assert not any(path.exists() for path in sets(folder))


def test_a_whole_number_means_the_same_as_a_real_one(generate: Generate, asked: Asked) -> None:
    for widen, length in (("2", "60"), ("2.0", "60.0")):
        generate(f"game.constants.length={length}", widen=widen)
    assert asked.total() == 10


def test_constants_change_the_key(generate: Generate, folder: Path) -> None:
    run = generate("game.constants.radius=1.3")
    assert run.code == 0
    request = Request((1.0, 1.0), 5, 0, "train", all_equilibria=True)
    assert label_set(make("narrow_road", radius=1.3), request, folder).read(5).status.tolist() == [0] * 5
    assert not any(path.exists() for path in sets(folder))


def test_cache_is_that_of_the_environment_by_default(
    generate: Generate, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HNO_CACHE", str(tmp_path / "environment"))
    assert generate(cache=None).code == 0
    assert all(path.exists() for path in sets(tmp_path / "environment"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"game": "narow_road"}, "Did you mean 'narrow_road'?"),
        *(({name: None}, f"{name} is missing") for name in ("theta", "n")),
        ({"starts": "5"}, "starts does not exist"),
        ({"function.members": "1"}, "function does not exist"),
        *(({"n": n}, "n must be a valid integer") for n in ("1.5", "many", "null", "true")),
        *(({name: "0"}, f"{name} must be greater than or equal to 1; got 0") for name in ("n", "workers")),
        ({"seed": "-1"}, "seed must be greater than or equal to 0; got -1"),
        ({"seed": "4294967296"}, "seed must be less than or equal to 4294967295; got 4294967296"),
        ({"workers": "all"}, "workers must be a valid integer; got 'all'"),
        *(({"widen": w}, "widen must be a finite number") for w in ("nan", "inf")),
        *(({"widen": w}, "widen must be a valid number") for w in ("wide", "true")),
        ({"widen": "0"}, "widen must be greater than 0; got 0"),
        ({"split": "foo"}, "split must be 'train' or 'test'; got 'foo'"),
        ({"theta": "grid1"}, "gridN (as in grid5)"),
        ({"theta": "1"}, "2 finite numbers"),
        ({"theta": "1,1;2"}, "2 finite numbers"),
        ({"game.constants.radios": "1.3"}, "Did you mean 'radius'?"),
        ({"game.constants.radius": "wide"}, "'radius' of narrow_road must be finite"),
        ({"game.constants": "5"}, "game.constants must be a valid dictionary; got 5"),
        ({"game.constants.radius": "[1"}, "++game.constants.radius=[1 cannot be read"),
        ({"cache": "/proc/nowhere"}, "Labels cannot be written to /proc/nowhere"),
    ],
    ids=str,
)
def test_impossible_options_are_one_line_and_nothing_is_written(
    generate: Generate, asked: Asked, folder: Path, change: dict[str, str | None], message: str
) -> None:
    run = generate(**change)
    assert run.code == (1 if "cache" in change else 2)
    assert message in run.err
    assert "Traceback" not in run.err
    assert not run.out
    assert not asked
    assert not folder.exists()


def test_words_without_a_value_are_refused(generate: Generate, folder: Path) -> None:
    run = generate("fast")
    assert run.code == 2
    assert "hno labels: what is 'fast'? Usage: hno labels game=NAME" in run.err
    assert not folder.exists()


def test_a_dry_run_prints_the_settings_and_solves_nothing(generate: Generate, asked: Asked, folder: Path) -> None:
    run = generate("--dry-run", game="drone")
    assert run.code == 0
    assert run.out.startswith("game:\n  name: drone\n  constants: {}\ntheta: 1,1;2.5,4\n")
    assert not asked
    assert not folder.exists()


def test_to_is_the_folder_of_label_sets(generate: Generate, tmp_path: Path) -> None:
    assert generate("--to", str(tmp_path / "a folder, mine"), cache=None).code == 0
    assert all(path.exists() for path in sets(tmp_path / "a folder, mine"))


def test_failed_rows_are_counted_and_their_advice_printed(generate: Generate, monkeypatch: pytest.MonkeyPatch) -> None:
    status = torch.tensor([Status.CONVERGED, Status.STALLED, Status.STALLED, Status.NOT_FINITE, Status.CONVERGED])

    def failing(game: Game, x0: Tensor, theta: Tensor, settings: Solver, *, all_equilibria: bool) -> Extremal:
        return fake_solve(game, x0, theta)._replace(status=status)

    monkeypatch.setattr(label_data, "solve", failing)
    run = generate()
    assert run.code == 0
    assert cells(run.out, "1, 1")[1:3] == ["5", "2"]
    assert "10 of 10: 4 converged, 6 failed" in run.out
    printed = " ".join(run.out.split())
    assert f"4 stalled: {Status.STALLED.advice}." in printed
    assert f"2 not_finite: {Status.NOT_FINITE.advice}." in printed
    assert "max_steps:" not in printed


def test_a_damaged_shard_is_moved_aside_and_solved_again(generate: Generate, folder: Path) -> None:
    generate()
    path = sets(folder)[1] / "shard-00000.safetensors"
    sound = path.read_bytes()
    path.write_bytes(sound[:-5])
    assert generate().code == 0
    assert path.read_bytes() == sound
    assert path.with_name(f"{path.name}.damaged").read_bytes() == sound[:-5]


@pytest.mark.parametrize(
    ("accident", "code", "message"),
    [
        (functools.partial(Interrupted, 2), 130, "the same command goes on from here"),
        (BrokenProcessPool, 1, "Finished shards are kept: try fewer workers"),
    ],
)
def test_finished_shards_survive_an_accident(
    generate: Generate,
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    asked: Asked,
    accident: Callable[[], BaseException],
    code: int,
    message: str,
) -> None:
    solver = label_data.solve

    def interrupted(game: Game, x0: Tensor, theta: Tensor, settings: Solver, *, all_equilibria: bool) -> Extremal:
        if asked.total() >= 2 * SHARD:
            raise accident()
        return solver(game, x0, theta, settings, all_equilibria=all_equilibria)

    with monkeypatch.context() as patch:
        patch.setattr(label_data, "solve", interrupted)
        run = generate(n="300")
    assert run.code == code
    assert message in run.err
    assert [path.name for path in sorted(sets(folder)[0].glob("shard-*"))] == [
        "shard-00000.safetensors", "shard-00001.safetensors",
    ]  # fmt: skip
    assert generate(n="300").code == 0
    assert asked.total() == 600
