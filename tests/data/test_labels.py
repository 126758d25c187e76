from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hno.data import labels as label_data
from hno.data import shards
from hno.data.labels import Progress, Request, default_cache, label_set, labels_for, start_states
from hno.games import Game, make
from hno.pontryagin.solve import Solver
from hno.types import Extremal, Status
from tests.conftest import TRAIN
from tests.data.conftest import Asked
from tests.fakes import fake_labels, fake_solve

REQUEST = Request((1.0, 5.0), 6, 0, "train")


def bits(labels: Extremal) -> list[bytes]:
    return [tensor.numpy().tobytes() for tensor in labels]


@pytest.mark.parametrize("name", ["narrow_road", "lane_change", "drone"])
def test_start_states_lie_in_the_start_box(name: str) -> None:
    game = make(name)
    states = start_states(game, REQUEST._replace(starts=200))
    assert states.dtype == torch.float64
    assert bool(game.initial_box.contains(states).all())
    assert float(game.initial_box.scale(states).abs().amax((0, 1, 2))) > 0.95


def test_start_states_are_a_function_of_the_request() -> None:
    game = make("narrow_road")
    states = start_states(game, REQUEST)
    torch.manual_seed(5)
    assert torch.equal(start_states(make("narrow_road"), REQUEST), states)


@pytest.mark.parametrize("change", [{"split": "test"}, {"seed": 1}, {"theta": (5.0, 1.0)}])
def test_different_requests_share_no_start_state(change: dict[str, object]) -> None:
    game = make("narrow_road")
    ours = start_states(game, REQUEST._replace(starts=50)).flatten(1)
    theirs = start_states(game, REQUEST._replace(starts=50)._replace(**change)).flatten(1)
    assert not bool((ours.unsqueeze(1) == theirs).any())


def test_start_states_do_not_depend_on_the_default_precision() -> None:
    states = start_states(make("narrow_road"), REQUEST)
    try:
        torch.set_default_dtype(torch.float64)
        assert torch.equal(start_states(make("narrow_road"), REQUEST), states)
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("theta", [(1, 5), (1.0, 5.0)])
def test_whole_types_are_the_same_as_floats(tmp_path: Path, theta: tuple[float, float]) -> None:
    game, request = make("narrow_road"), REQUEST._replace(theta=theta)
    assert torch.equal(start_states(game, request), start_states(game, REQUEST))
    assert label_set(game, request, tmp_path) == label_set(game, REQUEST, tmp_path)


def test_more_starts_begin_with_the_fewer() -> None:
    game = make("narrow_road")
    assert torch.equal(start_states(game, REQUEST._replace(starts=9))[:6], start_states(game, REQUEST))


def test_widened_start_box() -> None:
    game = make("narrow_road")
    wide = start_states(game, REQUEST._replace(starts=300, widen=2.0))
    assert bool(game.initial_box.widened(2.0).contains(wide).all())
    assert not bool(game.initial_box.contains(wide).all())


def test_key_is_the_same_for_the_same_content(tmp_path: Path) -> None:
    first = label_set(make("narrow_road"), REQUEST, tmp_path)
    assert label_set(make("narrow_road"), REQUEST, tmp_path, Solver()) == first
    assert label_set(make("narrow_road", radius=1.25), REQUEST, tmp_path) == first
    whole, real = (label_set(make("narrow_road", radius=radius), REQUEST, tmp_path) for radius in (1, 1.0))
    assert whole == real


def test_key_is_the_same_for_any_number_of_starts(tmp_path: Path) -> None:
    few, many = (label_set(make("narrow_road"), REQUEST._replace(starts=n), tmp_path) for n in (1, 1000))
    assert few == many
    assert few.provenance == many.provenance


@pytest.mark.parametrize(
    "change",
    [
        {"game": make("narrow_road", radius=1.3)},
        {"game": make("narrow_road", radius=1.2500001)},
        {"game": make("narrow_road", speed=17.0)},
        {"game": make("narrow_road", horizon=2.0)},
        {"game": make("lane_change")},
        {"request": REQUEST._replace(theta=(5.0, 1.0))},
        {"request": REQUEST._replace(theta=(1.0000001, 5.0))},
        {"request": REQUEST._replace(seed=1)},
        {"request": REQUEST._replace(split="test")},
        {"request": REQUEST._replace(widen=2.0)},
        {"settings": Solver(extra_nodes=61)},
        {"settings": Solver(reintegration=1e-5)},
        {"settings": Solver(newton=Solver().newton._replace(tolerance=1e-7))},
        {"settings": Solver(search=Solver().search._replace(margin=0.5))},
    ],
    ids=lambda change: str(next(iter(change.items())))[:60],
)
def test_key_changes_with_whatever_determines_labels(tmp_path: Path, change: dict[str, object]) -> None:
    same = {"game": make("narrow_road"), "request": REQUEST, "cache": tmp_path, "settings": Solver()}
    assert label_set(**(same | change)) != label_set(**same)


def test_key_changes_with_the_version_of_the_solver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = label_set(make("narrow_road"), REQUEST, tmp_path)
    monkeypatch.setattr(label_data, "SOLVER_VERSION", label_data.SOLVER_VERSION + 1)
    assert label_set(make("narrow_road"), REQUEST, tmp_path) != before


def test_cache_folder_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HNO_CACHE", str(tmp_path))
    assert default_cache() == tmp_path
    monkeypatch.delenv("HNO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    assert default_cache() == tmp_path / "user" / "hno"
    monkeypatch.setenv("HNO_CACHE", "")
    assert default_cache() == tmp_path / "user" / "hno"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert default_cache() == Path.home() / ".cache" / "hno"


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, ...]]:
    """The types that were asked of a solver that answers at once; it fails for theta = (9, 9)."""
    asked: list[tuple[float, ...]] = []

    def answer(game: Game, x0: Tensor, theta: Tensor, settings: Solver, *, all_equilibria: bool) -> Extremal:
        asked.append(tuple(theta[0].tolist()))
        if asked[-1] == (9.0, 9.0):
            raise RuntimeError("power cut")
        return fake_labels(game, theta[0].tolist(), len(x0), start=x0)

    monkeypatch.setattr(label_data, "solve", answer)
    return asked


def test_solved_labels_are_read_and_not_solved_again(tmp_path: Path, calls: list[tuple[float, ...]]) -> None:
    game, requests = make("narrow_road"), [REQUEST, REQUEST._replace(theta=(2.0, 2.0))]
    first, _ = labels_for(game, requests[:1], tmp_path, workers=1)
    both, _ = labels_for(game, requests, tmp_path, workers=1)
    assert calls == [(1.0, 5.0), (2.0, 2.0)]
    assert all(map(torch.equal, first[0], both[0]))
    assert torch.equal(both[1].theta[0], torch.tensor([2.0, 2.0], dtype=torch.float64))


def test_an_interrupted_generation_keeps_what_is_complete(tmp_path: Path, calls: list[tuple[float, ...]]) -> None:
    game, requests = make("narrow_road"), [REQUEST, REQUEST._replace(theta=(9.0, 9.0))]
    with pytest.raises(RuntimeError, match="power cut"):
        labels_for(game, requests, tmp_path, workers=1)
    assert list(tmp_path.rglob("shard-*")) == [label_set(game, REQUEST, tmp_path).path(0)]
    assert len(label_set(game, REQUEST, tmp_path).read(6).status) == 6


def test_shards_are_joined_in_the_order_of_the_starts(tmp_path: Path, asked: Asked) -> None:
    game, request = make("narrow_road"), REQUEST._replace(starts=300)
    (found,), _ = labels_for(game, [request], tmp_path, workers=1)
    assert torch.equal(found.x[:, 0], start_states(game, request))


def test_progress_counts_the_rows_that_are_solved(tmp_path: Path, asked: Asked) -> None:
    game, told = make("narrow_road"), list[Progress]()
    for starts in (100, 300, 300):
        labels_for(game, [REQUEST._replace(starts=starts)], tmp_path, workers=1, report=told.append)
    assert told == [(0, 100, 0), (100, 100, 100), (0, 200, 0), (28, 200, 28), (156, 200, 156), (200, 200, 200)]


def test_progress_tells_converged_rows_from_failed_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def every_other(game: Game, x0: Tensor, theta: Tensor, settings: Solver, *, all_equilibria: bool) -> Extremal:
        return fake_solve(game, x0, theta)._replace(status=torch.arange(len(x0)) % 2)

    monkeypatch.setattr(label_data, "solve", every_other)
    told: list[Progress] = []
    (found,), _ = labels_for(make("narrow_road"), [REQUEST], tmp_path, workers=1, report=told.append)
    assert told == [(0, 6, 0), (6, 6, 3)]
    assert found.status.tolist() == [0, 1, 0, 1, 0, 1]


def test_requests_of_one_set_share_its_rows(tmp_path: Path, asked: Asked) -> None:
    requests = [REQUEST._replace(starts=starts) for starts in (100, 300, 100)]
    found, _ = labels_for(make("narrow_road"), requests, tmp_path, workers=1)
    assert [len(labels.status) for labels in found] == [100, 300, 100]
    assert sum(asked.values()) == 300
    assert torch.equal(found[0].value, found[1].value[:100])


def test_unwritable_folder_is_refused_before_solving(calls: list[tuple[float, ...]]) -> None:
    with pytest.raises(OSError, match=r"/proc/labels.*\$HNO_CACHE"):
        labels_for(make("narrow_road"), [REQUEST], Path("/proc/labels"), workers=1)
    assert not calls


def test_a_damaged_file_is_solved_again_and_no_other(tmp_path: Path, calls: list[tuple[float, ...]]) -> None:
    game, other = make("narrow_road"), REQUEST._replace(theta=(2.0, 2.0))
    labels_for(game, [REQUEST, other], tmp_path, workers=1)
    path = label_set(game, REQUEST, tmp_path).path(0)
    path.write_bytes(path.read_bytes()[:-5])
    calls.clear()
    labels_for(game, [other, REQUEST], tmp_path, workers=1)
    assert calls == [REQUEST.theta]


@pytest.mark.parametrize(
    ("processes", "sizes"), [((2,), (1, 4)), pytest.param((1, 2), (1, 3, 4), marks=pytest.mark.slow)]
)
def test_labels_are_equal_bit_for_bit_however_they_are_split(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    labels: Callable[..., Extremal],
    processes: tuple[int, ...],
    sizes: tuple[int, ...],
) -> None:
    """Solved at once, shard by shard in one process or in two, and as an extension of a smaller set."""
    game, once = make("narrow_road"), bits(labels("narrow_road"))
    assert bool((labels("narrow_road").status == Status.CONVERGED).all())
    for module in (label_data, shards):
        monkeypatch.setattr(module, "SHARD", 2)
    for workers in processes:
        assert bits(labels_for(game, [TRAIN], tmp_path / str(workers), workers=workers)[0][0]) == once
    for starts in sizes:
        (found,), _ = labels_for(game, [TRAIN._replace(starts=starts)], tmp_path / "grown", workers=1)
    assert bits(found) == once


def test_labels_start_where_they_were_asked(labels: Callable[..., Extremal]) -> None:
    found = labels("narrow_road")
    assert torch.equal(found.x[:, 0], start_states(make("narrow_road"), TRAIN))
