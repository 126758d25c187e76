# ruff: noqa: E501
"""Configurations that make no run, paths of any name, and files that would run code."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hno.cli.arguments import LINE, as_path, one_screen, quoted
from hno.cli.main import main
from hno.cli.schema import places
from hno.cli.settings import COMMANDS

NAMES = (
    "a b=(c)", "a=b", "it's", 'a"b', "x,y", "ünïcode/ラン", "[x]", "{a: b}", "a\\", "a\\'b", "$HOME", "a#b", "~x", "1", "1e5",
    "true", "*?", "a:b", "(x)", "a\tb", "'a", "a'", "@x", "%", "a;b", "a&b|c<d>", "???", "a ", " a", "choice(x)", "=", "..",
)  # fmt: skip
KEYS = (
    "seed", "trainer.max_steps", "trainer.gradient_clip_val", "optimizer.lr", "optimizer", "game", "game.name", "data.types",
    "game.constants.radius", "network.depth", "activation.name", "data.pretrain", "data.files", "data.cache", "resume",
    "logger.names", "evaluation.dt", "evaluation.types", "validation.seed", "loss.weights.value", "loss.terms.value",
    "sampler.band", "function.members", "trainer._target_", "_target_", "nothing", "hydra.job.chdir", "hydra.run.dir",
)  # fmt: skip
VALUES = (
    "", "null", "nan", "inf", "-1", "0", "1.5", "5000000000", "1e400", "true", "[]", "{}", "[[1,1],[2]]", "{_target_: os.system}",
    "${nothing}", "${oc.env:HOME}", "${oc.decode:'x['}", "${oc.env:NOT_THERE}", "${seed}", "${", "ラン", "x" * 5000, "a b", "=", "'",
    "os.system", "${oc.create:{a:1}}",
)  # fmt: skip
SMOKE = ("experiment=smoke", "data.types=[[1,1]]", "data.workers=1", "evaluation.dt=0.1", "--dry-run")


def rows(text: str) -> int:
    """Lines of a terminal that a text fills."""
    return sum(1 + max(0, len(line) - 1) // LINE for line in text.splitlines())


@pytest.mark.parametrize("name", NAMES)
def test_a_path_of_any_name_is_read_as_it_stands(name: str) -> None:
    parser = OverridesParser.create()
    for value in (as_path(name), quoted(name)):
        override = parser.parse_override(f"++key={value}")
        assert override.value() == name
        assert not override.is_sweep_override()


@given(st.text(st.characters(exclude_characters="\n\r", exclude_categories=["Cs", "Cc"]), min_size=1))
def test_any_text_is_read_as_it_stands(text: str) -> None:
    assert OverridesParser.create().parse_override(f"++key={quoted(text)}").value() == text


def test_every_path_of_the_schema_is_known() -> None:
    assert places(COMMANDS["train"]) == {"data.cache": False, "data.files": True, "resume": False}
    assert places(COMMANDS["evaluate"]) == {"checkpoint": True, "cache": False}
    assert places(COMMANDS["labels"]) == {"cache": False}
    assert places(COMMANDS["report"]) == {"folder": False, "to": False}


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_of_any_name_is_reported_on(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "inside" / name  # .. is our own folder too
    folder.mkdir(parents=True, exist_ok=True)
    assert main(["report", str(folder)]) == 2
    assert "no results.json" in capsys.readouterr().err


@given(st.lists(st.text(max_size=3000), max_size=60))
def test_a_message_fills_one_screen_at_most(lines: list[str]) -> None:
    assert rows(one_screen("\n".join(lines))) <= 24


def fuzz(cases: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Dry runs of random overrides: valid, or refused on one screen."""
    codes: list[int] = []
    override = st.tuples(st.sampled_from(KEYS), st.sampled_from(VALUES) | st.integers().map(str) | st.floats().map(str))

    @settings(
        max_examples=cases, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None
    )
    @given(st.lists(override, min_size=1, max_size=2))
    def tried(overrides: list[tuple[str, str]]) -> None:
        capsys.readouterr()
        code = main(["train", *SMOKE, *(f"{key}={value}" for key, value in overrides)])
        said = capsys.readouterr()
        codes.append(code)
        assert code in (0, 2)
        assert code == 0 or (said.err and rows(said.err) <= 24)
        assert "Traceback" not in said.err + said.out

    tried()
    assert set(codes) == {0, 2}
    print(f"{len(codes)} cases: {codes.count(2)} refused, {codes.count(0)} valid")


def test_configurations_are_valid_or_refused_on_one_screen(capsys: pytest.CaptureFixture[str]) -> None:
    fuzz(8, capsys)


@pytest.mark.slow
def test_many_configurations_are_valid_or_refused_on_one_screen(capsys: pytest.CaptureFixture[str]) -> None:
    fuzz(2000, capsys)


@pytest.mark.parametrize("word", ["network.depth=5000000000", "network.width=100000", "function.members=1000001"])
def test_sizes_that_would_fill_the_memory_are_refused(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", *SMOKE, "function=value", word]) == 2
    assert f"{word.split('=')[0]} must be" in capsys.readouterr().err


@pytest.mark.parametrize(("mode", "code"), [("", 0), ("offline", 0), ("nonsense", 2)])
def test_modes_of_wandb(mode: str, code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", mode)
    assert main(["train", *SMOKE, "logger=wandb"]) == code


@pytest.mark.parametrize(
    "text",
    [
        "hydra: {callbacks: {x: {_target_: builtins.open, file: CANARY, mode: w}}}",
        "hydra: {job_logging: {handlers: {x: {class: logging.FileHandler, filename: CANARY}}}}",
        "hydra: {job_logging: {handlers: {x: {(): builtins.open, file: CANARY, mode: w}}}}",
        "hydra: {job: {env_set: {LD_PRELOAD: CANARY}}}",
        "hydra: {launcher: {_target_: os.system}}",
        "game: {_target_: os.system}",
        "? !!python/object/apply:os.system ['touch CANARY']\n: 1",
        "x: !!python/object/apply:os.system ['touch CANARY']",
        "game: [unfinished",
    ],
)
@pytest.mark.parametrize("many", [(), ("-m",)])
def test_files_that_would_run_code_are_refused(
    tmp_path: Path, text: str, many: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    canary = tmp_path / "canary"
    (tmp_path / "conf" / "experiment").mkdir(parents=True)
    file = tmp_path / "conf" / "experiment" / "theirs.yaml"
    file.write_text("# @package _global_\n" + text.replace("CANARY", str(canary)))
    words = ["--config-dir", str(tmp_path / "conf"), "experiment=theirs", "--to", str(tmp_path / "run")]
    assert main(["train", *many, *words]) == 2
    assert str(file) in capsys.readouterr().err
    assert not canary.exists()
    assert not (tmp_path / "run").exists()
