"""Checkpoints with a sound checksum that somebody made in order to harm or to mislead."""

from __future__ import annotations

import hashlib
import io
import math
import os
import pickle
import resource
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hno.registry import UnknownNameError
from hno.training.checkpoint import CheckpointError, check_training_state, load_operator, read_checkpoint
from hno.training.saving import DIGITS, MARK, seal
from tests.faults.checkpoints import content, operator_content, run

GIB = 2**30


@contextmanager
def little_memory(more: int = 3 * GIB) -> Iterator[None]:
    """No more address space than that."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + more, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def refused(path: Path, whole: object) -> str:
    path.write_bytes(seal(whole))
    with little_memory(), pytest.raises(CheckpointError) as error:
        load_operator(path)
    message = str(error.value)
    assert message.startswith(str(path))
    assert len(message) < 1000, "more than a screen"
    assert "\n" not in message
    return message


def test_the_checkpoint_that_all_cases_change_is_loaded(tmp_path: Path) -> None:
    (tmp_path / "a.ckpt").write_bytes(seal(operator_content()))
    load_operator(tmp_path / "a.ckpt")


def architecture(part: str, **options: Any) -> dict[str, Any]:
    """A header with some options of a part of the operator replaced."""
    whole = operator_content()
    whole["hno"]["architecture"][part]["options"] |= options
    return whole


SIZES = [("network", {"depth": size}) for size in (10**7, 10**12, 10**30)]
SIZES += [("network", {"width": size}) for size in (10**4, 10**6, 10**9, 10**30)]
SIZES += [("function", {"members": size}) for size in (10**6 + 1, 10**12 + 1)]


@pytest.mark.parametrize(("part", "options"), SIZES)
def test_sizes_are_those_of_the_weights_before_anything_large_is_made(
    tmp_path: Path, part: str, options: dict[str, int]
) -> None:
    assert "does not hold the weights" in refused(tmp_path / "a.ckpt", architecture(part, **options))


JUNK: list[Any] = [None, -1, 0, 1e9, math.nan, "x", "x" * 10**6, [], [1], {}, {"a": {}}, True, torch.zeros(2), 10**400]
ENTRIES = list(operator_content()["hno"])
ORIGIN = operator_content()["hno"]["provenance"]
HOW: dict[str, Callable[[Any], dict[str, Any]]] = {
    **{name: lambda junk, name=name: operator_content(**{name: junk}) for name in ("game", "constants", "fingerprint")},
    **{
        name: lambda junk, name=name: operator_content(**{name: junk})
        for name in ("architecture", "provenance", "format")
    },
    "constant": lambda junk: operator_content(constants={"radius": junk}),
    "types": lambda junk: operator_content(provenance=ORIGIN | {"types": junk}),
    "type": lambda junk: operator_content(
        provenance=operator_content()["hno"]["provenance"] | {"types": [(junk, 1.0)]}
    ),
    "further": lambda junk: operator_content(provenance=ORIGIN | {"_target_": junk}),
    "width": lambda junk: architecture("network", width=junk),
    "members": lambda junk: architecture("function", members=junk),
    "weights": lambda junk: operator_content() | {"state_dict": junk},
    "weight": lambda junk: changed("operator.value_scale", junk),
    "record": lambda junk: operator_content() | {"hno": junk},
}


def changed(name: str, value: Any) -> dict[str, Any]:
    """One entry of the weights replaced."""
    whole = operator_content()
    assert name in whole["state_dict"]
    whole["state_dict"][name] = value
    return whole


@pytest.mark.parametrize("where", HOW)
def test_junk_is_a_checkpoint_error(tmp_path: Path, where: str) -> None:
    same = {"constants": [{}], "members": [True], "type": [-1, 0, 1e9, True], "types": [[]]}
    for junk in JUNK:
        if any(type(junk) is type(value) and junk == value for value in same.get(where, [])):
            continue  # what a checkpoint may say
        with suppress(UnknownNameError):
            refused(tmp_path / "a.ckpt", HOW[where](junk))


def nested(depth: int, kind: Callable[[Any], Any]) -> Any:
    inner: Any = 1
    for _ in range(depth):
        inner = kind(inner)
    return inner


def deep(depth: int) -> bytes:
    """A pickle of lists in lists, which Python itself cannot write."""
    return b"\x80\x02" + b"]" * depth + b"a" * (depth - 1) + b"."


def archive(data: bytes, compression: int = zipfile.ZIP_STORED, zeros: int = 0) -> bytes:
    """An archive as torch writes it, with a pickle of one's choice and a sound checksum."""
    plain, buffer = io.BytesIO(seal({"weight": torch.zeros(4)})), io.BytesIO()
    with zipfile.ZipFile(plain) as old, zipfile.ZipFile(buffer, "w", compression) as new:
        for entry in old.infolist():
            new.writestr(entry.filename, data if entry.filename.endswith("data.pkl") else old.read(entry))
        if zeros:
            new.writestr("archive/data/1", bytes(zeros))
    return resealed(buffer.getvalue())


def resealed(whole: bytes) -> bytes:
    """A zip archive with our checksum at its end."""
    body = whole[:-2] + (len(MARK) + DIGITS).to_bytes(2, "little") + MARK
    return body + hashlib.sha256(body).hexdigest().encode()


def test_deep_nesting_and_shared_parts_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    bombs = [archive(deep(10**5)), archive(pickle.dumps(nested(40, lambda inner: [inner] * 10), protocol=2))]
    cycle: list[Any] = []
    cycle.append(cycle)
    bombs.append(seal({"loop": cycle}))
    for bomb in bombs:
        path.write_bytes(bomb)
        with little_memory(), pytest.raises(CheckpointError, match="more than 32 levels or 1000000 entries"):
            load_operator(path)
    towers = b"\x85" * 10**6, b"".join(b"q" + bytes([i]) + b"h" + bytes([i]) + b"\x86" for i in range(100))
    for tower in towers:  # as the key of a dictionary: hashing it would need a stack as deep, or 2^100 steps
        path.write_bytes(archive(b"\x80\x02})" + tower + b"K\x01s."))
        with pytest.raises(CheckpointError, match="a tuple has more than 32 levels or 1000000 entries"):
            load_operator(path)
    for kind in (lambda inner: [inner], lambda inner: {"a": inner}):
        refused(path, operator_content(constants={"radius": nested(200, kind)}))
        refused(path, operator_content() | {"callbacks": nested(200, kind)})


def test_a_file_that_unpacks_to_more_than_its_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    path.write_bytes(archive(pickle.dumps({}, protocol=2), zipfile.ZIP_DEFLATED, zeros=2**28))
    assert path.stat().st_size < 2**20
    with pytest.raises(CheckpointError, match="its entries are compressed"):
        load_operator(path)
    path.write_bytes(seal(operator_content() | {"large": torch.zeros(1).expand(10**12)}))
    with little_memory(), pytest.raises(CheckpointError, match="a tensor has more entries than the file"):
        load_operator(path)


PHYSICS = "operator.game.control_box.hi", "operator.problem.control_box.hi", "operator.game.state_box.lo"
SCALES = "operator.value_scale", "operator.costate_scale"


@pytest.mark.parametrize("name", PHYSICS)
def test_a_checkpoint_cannot_change_the_game(tmp_path: Path, name: str) -> None:
    whole = operator_content()
    both = [entry for entry in whole["state_dict"] if entry.split(".", 2)[-1] == name.split(".", 2)[-1]]
    for entry in both:
        whole["state_dict"][entry] = whole["state_dict"][entry] + 1e-6 * whole["state_dict"][entry].abs().max()
    assert "is not that of the game" in refused(tmp_path / "a.ckpt", whole)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", SCALES)
def test_scales_are_positive_and_finite(tmp_path: Path, name: str, value: float) -> None:
    like = operator_content()["state_dict"][name]
    assert "does not hold the weights" in refused(tmp_path / "a.ckpt", changed(name, torch.full_like(like, value)))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_weights_are_finite(tmp_path: Path, value: float) -> None:
    whole = operator_content()
    name = next(name for name in whole["state_dict"] if name.endswith("layers.0.weight"))
    whole["state_dict"][name][0, 0] = value
    assert "is not finite" in refused(tmp_path / "a.ckpt", whole)


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64, torch.complex64])
def test_weights_are_real_numbers(tmp_path: Path, dtype: torch.dtype) -> None:
    value = torch.ones((), dtype=dtype)
    assert f"is {dtype}, expected torch.float32" in refused(tmp_path / "a.ckpt", changed(SCALES[0], value))


class Canary:
    """Unpickling this makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("where", ["hno", "state_dict", "callbacks", "optimizer_states", "hyper_parameters"])
def test_code_in_any_entry_does_not_run(tmp_path: Path, where: str) -> None:
    canary = tmp_path / "canary"
    assert "unsafe" in refused(tmp_path / "a.ckpt", operator_content() | {where: {"_target_": Canary(canary)}})
    assert not canary.exists()
    torch.load(tmp_path / "a.ckpt", weights_only=False)
    assert canary.exists(), "the canary itself works"


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@st.composite
def headers(draw: st.DrawFn) -> Any:
    """Records of which any part is replaced, left out or added."""
    whole = operator_content()["hno"]
    for _ in range(draw(st.integers(1, 3))):
        at = whole
        while True:
            key = draw(st.sampled_from([*at, "further"]) | st.text(max_size=8))
            if isinstance(at.get(key), dict) and draw(st.booleans()):
                at = at[key]
                continue
            if draw(st.integers(0, 4)) == 0:
                at.pop(key, None)
            else:
                at[key] = draw(PLAIN | st.sampled_from([10**7, 10**400, -1, 1e308, math.nan, "x" * 2000]))
            break
    return whole


def only_our_errors(folder: Path, header: Any) -> None:
    path = folder / "a.ckpt"
    path.write_bytes(seal(operator_content() | {"hno": header}))
    with suppress(CheckpointError, UnknownNameError):
        load_operator(path)


CHECKS = {"deadline": None, "suppress_health_check": list(HealthCheck), "database": None, "derandomize": True}


@settings(max_examples=100, **CHECKS)
@given(header=headers())
def test_a_header_ends_in_our_errors_only(tmp_path_factory: pytest.TempPathFactory, header: Any) -> None:
    only_our_errors(tmp_path_factory.getbasetemp(), header)


@pytest.mark.slow
def test_ten_thousand_headers_end_in_our_errors_only(tmp_path: Path) -> None:
    count = 0

    @settings(max_examples=10_000, **CHECKS)
    @given(header=headers())
    def tried(header: Any) -> None:
        nonlocal count
        count += 1
        only_our_errors(tmp_path, header)

    tried()
    print(f"{count} cases: headers of checkpoints")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The last checkpoint of a small run."""
    folder = tmp_path_factory.mktemp("trained")
    run(folder)
    return content(folder / "last.ckpt")


def without(whole: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in whole.items() if key != name}


STATE = {
    "no loops": lambda whole: without(whole, "loops"),
    "empty loops": lambda whole: whole | {"loops": {}},
    "no optimizer": lambda whole: without(whole, "optimizer_states"),
    "two optimizers": lambda whole: whole | {"optimizer_states": whole["optimizer_states"] * 2},
    "empty optimizer": lambda whole: whole | {"optimizer_states": [whole["optimizer_states"][0] | {"state": {}}]},
    "no groups": lambda whole: whole | {"optimizer_states": [{"state": whole["optimizer_states"][0]["state"]}]},
    "no rates": lambda whole: without(whole, "lr_schedulers"),
    "another step": lambda whole: whole | {"global_step": 10**9},
    "step before 0": lambda whole: whole | {"global_step": -1},
    "junk callbacks": lambda whole: whole | {"callbacks": [1, 2]},
    "junk callback": lambda whole: whole | {"callbacks": {"StopOnDivergence": 3}},
}


@pytest.mark.parametrize("how", STATE)
def test_a_training_does_not_go_on_without_its_state(trained: dict[str, Any], how: str) -> None:
    check_training_state("a.ckpt", trained, 8)
    with pytest.raises(CheckpointError, match=r"a\.ckpt cannot be resumed from: .*"):
        check_training_state("a.ckpt", STATE[how](trained), 8)


def test_a_checkpoint_beyond_the_end_is_refused(trained: dict[str, Any]) -> None:
    with pytest.raises(CheckpointError, match=r"a\.ckpt is at step 8, the run ends at step 7\."):
        check_training_state("a.ckpt", trained, 7)


def moments(whole: dict[str, Any]) -> dict[str, Any]:
    """The state of the first matrix of weights."""
    return next(kept for kept in whole["optimizer_states"][0]["state"].values() if kept["exp_avg"].dim() > 1)


RESTORED = {
    "a callback": lambda whole: whole["callbacks"]["StopOnDivergence"].clear(),
    "the data": lambda whole: whole["GameData"].update(visits=[3]),
    "a loop": lambda whole: whole["loops"]["fit_loop"].pop("epoch_loop.batch_progress"),
    "the groups": lambda whole: whole["optimizer_states"][0]["param_groups"].append({"params": []}),
    "the weights": lambda whole: whole["state_dict"].popitem(),
    "a moment": lambda whole: moments(whole).update(exp_avg=torch.zeros(3)),
    "a moment of more axes": lambda whole: moments(whole).update(exp_avg=moments(whole)["exp_avg"][None]),
    "a moment of one number": lambda whole: moments(whole).update(exp_avg_sq=torch.tensor(1.0)),
    "no moment": lambda whole: moments(whole).pop("exp_avg_sq"),
    "a number for a moment": lambda whole: moments(whole).update(exp_avg=3.0),
    "preconditioners": lambda whole: moments(whole).update(GG=[torch.eye(2)] * 2, Q=[torch.eye(2)] * 2),
}


@pytest.mark.parametrize("part", RESTORED)
def test_what_cannot_be_restored_is_a_checkpoint_error(trained: dict[str, Any], tmp_path: Path, part: str) -> None:
    whole = torch.load(io.BytesIO(seal(trained)), weights_only=True)
    RESTORED[part](whole)
    path = tmp_path / "last.ckpt"
    path.write_bytes(seal(whole))
    with pytest.raises(CheckpointError, match=f"{path} (cannot be resumed from|does not fit this run): "):
        run(tmp_path, resume=path, steps=12)


def test_reading_needs_no_building(tmp_path: Path) -> None:
    """The record is judged before its operator is made."""
    (tmp_path / "a.ckpt").write_bytes(seal(operator_content(architecture={"function": {}})))
    with pytest.raises(CheckpointError, match=r"has a bad entry 'hno': architecture\.function\.name: Field required"):
        read_checkpoint(tmp_path / "a.ckpt")
