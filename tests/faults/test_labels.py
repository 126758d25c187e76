"""Label files and manifests that are damaged, exchanged, foreign or hostile."""

from __future__ import annotations

import contextlib
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from hno.data import labels as label_data
from hno.data.exchange import from_arrays, read_own, to_arrays, write_own
from hno.data.labels import Request, label_set, labels_for
from hno.data.shards import MANIFEST, SHARD, LabelSet
from hno.data.store import KEY, LabelFileError, checksum, read_labels, start_count, write_labels
from hno.games import make
from hno.types import Extremal, Status
from tests.fakes import fake_labels, fake_solve
from tests.faults import label_files

GAME, REQUEST = make("narrow_road"), Request((1.0, 5.0), SHARD + 10, 0, "train")


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A solver that answers at once; the list is of how many rows were asked of it."""
    rows = list[int]()

    def answer(game: Any, x0: Tensor, theta: Tensor, options: Any, *, all_equilibria: bool) -> Extremal:
        rows.append(len(x0))
        return fake_solve(game, x0, theta)

    monkeypatch.setattr(label_data, "solve", answer)
    return rows


def fill(cache: Path, request: Request = REQUEST) -> tuple[LabelSet, Extremal]:
    (found,), _ = labels_for(GAME, [request], cache, workers=1)
    return label_set(GAME, request, cache), found


def same(one: Extremal, other: Extremal) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.usefixtures("solved")
@pytest.mark.parametrize("what", ["shard", "manifest"])
def test_no_flipped_byte_is_loaded_in_silence(tmp_path: Path, what: str, caplog: pytest.LogCaptureFixture) -> None:
    """100 of them: the labels are those of before, the file is said and written again as it was."""
    request = REQUEST._replace(starts=4)
    labels, wanted = fill(tmp_path, request)
    path, source = labels.path(0) if what == "shard" else labels.folder / MANIFEST, random.Random(0)
    content = path.read_bytes()
    for _ in range(100):
        flipped = bytearray(content)
        flipped[source.randrange(len(content))] ^= source.randrange(1, 256)
        path.write_bytes(flipped)
        caplog.clear()
        assert same(fill(tmp_path, request)[1], wanted)
        assert str(path) in caplog.text
        assert path.read_bytes() == content
    print(f"100 cases: one-byte flips of a {what}, all said and mended")


@pytest.mark.parametrize("numbered", [True, False])
def test_exchanged_shards_are_solved_again(tmp_path: Path, solved: list[int], *, numbered: bool) -> None:
    """Also those of older sets, which do not know their number."""
    request = REQUEST._replace(starts=2 * SHARD)
    labels, wanted = fill(tmp_path, request)
    paths = [labels.path(0), labels.path(1)]
    if not numbered:
        for path in paths:
            write_labels(path, read_labels(path)[0], labels.provenance)
        assert same(fill(tmp_path, request)[1], wanted), "sets without numbers stay valid"
    shutil.move(paths[0], tmp_path / "first")
    shutil.move(paths[1], paths[0])
    shutil.move(tmp_path / "first", paths[1])
    solved.clear()
    assert same(fill(tmp_path, request)[1], wanted)
    assert solved == [SHARD, SHARD]


@pytest.mark.usefixtures("solved")
def test_exchanged_ties_are_found_without_searching_for_ties(tmp_path: Path) -> None:
    labels = label_set(GAME, REQUEST._replace(ties=True), tmp_path)
    labels.append(1, 0, fake_labels(GAME, REQUEST.theta))
    labels.path(1).rename(labels.path(0))
    with pytest.raises(LabelFileError, match="is shard 1 of its set, under another name"):
        labels.read_shard(0)


def changed(name: str, change: Callable[[Tensor], object]) -> Callable[[Extremal], dict[str, Tensor]]:
    def columns(labels: Extremal) -> dict[str, Tensor]:
        column = getattr(labels, name).clone()
        change(column)
        return {name: column}

    return columns


def at(*place: int, value: float = torch.nan) -> Callable[[Tensor], object]:
    return lambda column: column.__setitem__(place, value)


FLAWS: dict[str, tuple[Callable[[Extremal], dict[str, Tensor]], str]] = {
    "unknown status": (changed("status", at(1, value=99)), "status is none of Status in row 1"),
    "negative status": (changed("status", at(1, value=-1)), "status is none of Status in row 1"),
    "decreasing times": (lambda labels: {"t": labels.t.flip(0)}, "t must increase"),
    "equal times": (changed("t", at(1, value=0.0)), "t must increase"),
    "NaN in times": (changed("t", at(3)), "t must increase"),
    "NaN state": (changed("x", at(2, 1, 0, 0)), "x is not finite, though the label converged in row 2"),
    "infinite costate": (changed("costate", at(3, 0, 0, 0, 0, value=torch.inf)), "costate is not finite.* in row 3"),
    "NaN control": (changed("u", at(0, 0, 0, 0)), "u is not finite.* in row 0"),
    "NaN value": (changed("value", at(3, 5, 1)), "value is not finite.* in row 3"),
    "NaN type": (changed("theta", at(0, 0)), "theta is not finite in row 0"),
    "NaN clearance": (changed("clearance", at(3)), "clearance is not finite.* in row 3"),
    "NaN re-integration": (changed("reintegration", at(3)), "reintegration is not finite.* in row 3"),
    "half a potential": (changed("potential", at(1, 2)), "potential is finite at some times only in row 1"),
    "starts that decrease": (lambda labels: {"start": labels.start.flip(0)}, "start must count"),
    "absurd starts": (changed("start", at(3, value=10**15)), "start must count"),
    "another dtype": (
        lambda labels: {"value": labels.value.to(torch.int64)},
        "value (cannot|holds)",
    ),
    "status as floats": (lambda labels: {"status": labels.status.double()}, "status holds torch.float64"),
    "fewer players": (lambda labels: {"value": labels.value[..., :1].contiguous()}, "value has shape"),
    "one node less": (lambda labels: {"t": labels.t[:-1].contiguous()}, "x has shape"),
    "other dimensions": (lambda labels: {"x": labels.x[0].contiguous()}, "status, t, x, u and alternatives have"),
    "no rows": (lambda labels: {"x": labels.x[:0].contiguous()}, "x has shape"),
}


@pytest.mark.parametrize("name", FLAWS)
def test_a_file_of_what_is_no_label_is_refused_by_name(tmp_path: Path, name: str) -> None:
    """Its last rows are those that are held out."""
    (change, message), labels, path = FLAWS[name], fake_labels(GAME, REQUEST.theta), tmp_path / "own.safetensors"
    provenance = {"game": type(GAME).__name__, "fingerprint": GAME.fingerprint()}
    label_files.write(path, labels, provenance)
    assert same(read_own(path, GAME), labels)
    label_files.write(path, labels, provenance, **change(labels))
    with pytest.raises(LabelFileError, match=rf"own\.safetensors holds no sound labels: .*({message})"):
        read_own(path, GAME)
    with pytest.raises(LabelFileError, match=r"new\.safetensors is not written"):
        write_labels(tmp_path / "new.safetensors", labels._replace(**change(labels)), provenance)
    assert not (tmp_path / "new.safetensors").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda labels: labels._replace(t=labels.t / 2), "t ends at 1.5 s, the horizon is 3 s"),
        (lambda labels: labels._replace(u=labels.u[..., :1]), "players, states and controls are 2, 4, 1"),
    ],
)
def test_labels_that_do_not_fit_the_game_are_refused(
    tmp_path: Path, change: Callable[[Extremal], Extremal], message: str
) -> None:
    write_own(tmp_path / "own", GAME, change(fake_labels(GAME)), "a test")
    with pytest.raises(LabelFileError, match=f"holds no labels of this game: {message}"):
        read_own(tmp_path / "own", GAME)


def test_what_did_not_converge_may_hold_anything(tmp_path: Path) -> None:
    labels = fake_labels(GAME, status=[Status.CONVERGED, Status.NOT_FINITE, Status.STALLED, Status.CONVERGED])
    for name in ("x", "value", "costate", "clearance", "residual"):
        getattr(labels, name)[1:3] = torch.nan
    write_own(tmp_path / "own", GAME, labels, "a test")
    assert read_own(tmp_path / "own", GAME).x[1].isnan().all()


def test_a_game_that_makes_nan_of_arrays_is_said(labels: Callable[..., Extremal], monkeypatch: Any) -> None:
    arrays = {name: part for name, part in to_arrays(labels("narrow_road")).items() if name in
              ("t", "x", "costate", "value", "theta")}  # fmt: skip
    monkeypatch.setattr("hno.data.exchange.reintegration_error", lambda game, at: torch.full((len(at.t),), torch.nan))
    with pytest.raises(ValueError, match="The game makes no labels of these arrays: reintegration is not finite"):
        from_arrays(GAME, arrays)


DEEP = "[" * 100_000
HOSTILE: dict[str, tuple[bytes, int | None]] = {
    "a header of 1 GB": (b"{}", 2**30),
    "a header of 2^63 bytes": (b"{}", 2**63),
    "nested header": (b'{"a":' * 100_000, None),
    "nested metadata": (json.dumps({"__metadata__": {KEY: DEEP}}).encode(), None),
    "closed nested metadata": (json.dumps({"__metadata__": {KEY: DEEP + "]" * 100_000}}).encode(), None),
    "an absurd shape": (b'{"status":{"dtype":"I64","shape":[1000000000000],"data_offsets":[0,8000000000000]}}', None),
    "an overflowing shape": (
        b'{"status":{"dtype":"I64","shape":[9223372036854775807,9223372036854775807],"data_offsets":[0,8]}}', None,
    ),
    "an empty absurd shape": (b'{"status":{"dtype":"I64","shape":[0,1000000000000],"data_offsets":[0,0]}}', None),
    "no tensor at all": (b'{"__metadata__":{"hno":"{}"}}', None),
    "metadata of another type": (b'{"__metadata__":{"hno":"[1,2]"}}', None),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_absurd_files_are_refused(tmp_path: Path, name: str) -> None:
    header, length = HOSTILE[name]
    label_files.raw(tmp_path / "labels", header, length=length)
    for read in (read_labels, checksum):
        with pytest.raises(LabelFileError, match="labels"):
            read(tmp_path / "labels")
    with contextlib.suppress(LabelFileError):
        assert start_count(tmp_path / "labels") == 0


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=10,
)
HEADER = st.fixed_dictionaries(
    {},
    optional={"format": st.just(2) | JSON, "sha256": JSON, "provenance": JSON, "starts": JSON},
).map(json.dumps)


def read_at_random(folder: Path, cases: int) -> int:
    """So many random headers and damaged files; how many were read, all of which must be the labels themselves."""
    labels, path = fake_labels(GAME, count=2), folder / "labels"
    write_labels(path, labels, {"a": 1})
    whole, read = path.read_bytes(), 0
    sound = json.loads(whole[8 : 8 + int.from_bytes(whole[:8], "little")].decode())
    good = json.loads(sound["__metadata__"][KEY])

    def metadata(text: str) -> bytes:
        header = json.dumps(sound | {"__metadata__": {KEY: text}}).encode()
        return len(header).to_bytes(8, "little") + header + whole[8 + int.from_bytes(whole[:8], "little") :]

    files = st.one_of(
        (HEADER | st.text(max_size=40)).map(metadata),
        JSON.map(lambda changed: metadata(json.dumps(good | {"starts": changed}))),
        st.binary(max_size=200),
        st.integers(0, len(whole)).map(lambda size: whole[:size]),
        st.tuples(st.integers(0, len(whole) - 1), st.integers(1, 255)).map(
            lambda flip: whole[: flip[0]] + bytes([whole[flip[0]] ^ flip[1]]) + whole[flip[0] + 1 :]
        ),
    )

    @settings(max_examples=cases, deadline=None, derandomize=True, database=None)
    @given(content=files)
    def check(content: bytes) -> None:
        nonlocal read
        path.write_bytes(content)
        for reader in (start_count, checksum):
            with contextlib.suppress(LabelFileError):
                reader(path)
        try:
            found, _ = read_labels(path)
        except LabelFileError:
            return
        read += 1
        assert same(found, labels)

    check()
    return read


def test_random_label_files_are_read_right_or_refused(tmp_path: Path) -> None:
    read_at_random(tmp_path, 100)


@pytest.mark.slow
def test_ten_thousand_random_label_files_are_read_right_or_refused(tmp_path: Path) -> None:
    print(f"10000 cases: random label files, of which {read_at_random(tmp_path, 10_000)} were read, rightly")


def manifests_at_random(folder: Path, cases: int) -> None:
    """After any manifest at all the labels are there, and the manifest is as it was."""
    request = REQUEST._replace(starts=2)
    labels, wanted = fill(folder, request)
    path = labels.folder / MANIFEST
    whole = path.read_bytes()
    content = json.loads(whole)
    changed = st.dictionaries(st.sampled_from([*content, "other"]), JSON, min_size=1, max_size=3)
    written = st.one_of(
        changed.map(lambda entries: json.dumps(content | entries).encode()),
        JSON.map(lambda anything: json.dumps(anything).encode()),
        st.binary(max_size=200),
        st.just(DEEP.encode()),
        st.integers(0, len(whole) - 1).map(lambda size: whole[:size]),
    )

    @settings(max_examples=cases, deadline=None, derandomize=True, database=None)
    @given(text=written)
    def check(text: bytes) -> None:
        path.write_bytes(text)
        assert same(fill(folder, request)[1], wanted)
        assert path.read_bytes() == whole

    check()


@pytest.mark.usefixtures("solved")
def test_random_manifests_are_written_again(tmp_path: Path) -> None:
    manifests_at_random(tmp_path, 50)


@pytest.mark.slow
@pytest.mark.usefixtures("solved")
def test_ten_thousand_random_manifests_are_written_again(tmp_path: Path) -> None:
    manifests_at_random(tmp_path, 10_000)
    print("10000 cases: random manifests, all written again")
