"""Label sets of several equilibria per start, and data that are drawn from several boxes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from hno.data import GameData, LabelPlan, shards
from hno.data import datamodule as module
from hno.data import labels as label_data
from hno.data.labels import Progress, Request, label_set, labels_for, start_states
from hno.data.shards import MANIFEST, LabelSet
from hno.data.store import start_count
from hno.games import Game, make
from hno.pontryagin.solve import Solver
from hno.types import Extremal, PotentialLabels, best_of, join, of_starts
from tests.fakes import fake_labels, fake_solve

REQUEST = Request((1.0, 5.0), 20, 0, "train", all_equilibria=True)
SHARD = 8


def count(x0: Tensor) -> int:
    """How many equilibria a start has here: one, two or three, as its state says."""
    return 1 + int(1e4 * float(x0.sum())) % 3


def several(game: Game, x0: Tensor, theta: Tensor) -> Extremal:
    """Fake labels of that many equilibria."""
    found = [fake_solve(game, start.expand(count(start), -1, -1), theta[:1].expand(count(start), -1)) for start in x0]
    rank = [torch.arange(len(each.start)) for each in found]
    one_each = [
        each._replace(
            start=0 * order, value=each.value - order[:, None, None], potential=each.potential - order[:, None]
        )
        for each, order in zip(found, rank, strict=True)
    ]
    return join(one_each)


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> list[Tensor]:
    """Start states of every call of a solver that answers at once, in small shards."""
    calls: list[Tensor] = []

    def answer(game: Game, x0: Tensor, theta: Tensor, settings: Solver, *, all_equilibria: bool) -> Extremal:
        calls.append(x0)
        return several(game, x0, theta) if all_equilibria else fake_solve(game, x0, theta)

    monkeypatch.setattr(label_data, "solve", answer)
    for place in (label_data, shards):
        monkeypatch.setattr(place, "SHARD", SHARD)
    return calls


def generated(cache: Path, starts: int) -> tuple[Extremal, LabelSet]:
    game, request = make("narrow_road"), REQUEST._replace(starts=starts)
    (found,), _ = labels_for(game, [request], cache, workers=1)
    return found, label_set(game, request, cache)


def bits(labels: Extremal) -> list[bytes]:
    return [tensor.numpy().tobytes() for tensor in labels]


def expected(starts: int) -> Extremal:
    game = make("narrow_road")
    x0 = start_states(game, REQUEST._replace(starts=starts))
    return several(game, x0, torch.tensor([REQUEST.theta]).double().expand(starts, -1))


def test_a_set_has_as_many_starts_as_were_asked_for_and_all_their_equilibria(
    tmp_path: Path, solved: list[Tensor]
) -> None:
    found, labels = generated(tmp_path, 20)
    assert found.starts == 20
    assert len(found.start) > 20
    assert bits(found) == bits(expected(20))
    assert torch.equal(best_of(found).x[:, 0], start_states(make("narrow_road"), REQUEST))
    assert [labels.starts(shard) for shard in range(4)] == [SHARD, SHARD, 4, 0]
    assert [start_count(labels.path(shard)) for shard in range(3)] == [SHARD, SHARD, 4]


@pytest.mark.parametrize("fewer", [1, 7, 8, 9, 19])
def test_fewer_starts_are_a_prefix(tmp_path: Path, solved: list[Tensor], fewer: int) -> None:
    generated(tmp_path, 20)
    solved.clear()
    found, _ = generated(tmp_path, fewer)
    assert not solved
    assert found.starts == fewer
    assert bits(found) == bits(expected(fewer))


@pytest.mark.parametrize("grown", [(5, 20), (1, 3, 8, 9, 20), (16, 20)])
def test_a_set_that_grew_equals_one_made_at_once(tmp_path: Path, solved: list[Tensor], grown: tuple[int, ...]) -> None:
    for starts in grown:
        found, labels = generated(tmp_path / "grown", starts)
    assert torch.equal(torch.cat(solved), start_states(make("narrow_road"), REQUEST)), "each start is solved once"
    _, once = generated(tmp_path / "once", 20)
    assert bits(found) == bits(expected(20))
    for name in (MANIFEST, *(once.path(shard).name for shard in range(3))):
        assert (labels.folder / name).read_bytes() == (once.folder / name).read_bytes()


def test_starts_that_two_processes_solved_are_kept_once(tmp_path: Path, solved: list[Tensor]) -> None:
    _, labels = generated(tmp_path, 2)
    for more in (5, 4, 7):
        labels.append(0, 2, of_starts(expected(more), 2))
    assert bits(labels.read_shard(0)) == bits(expected(7))


def test_all_equilibria_are_a_set_of_their_own(tmp_path: Path) -> None:
    """Sets of the best ones are older: their keys stay."""
    game, best = make("narrow_road"), REQUEST._replace(all_equilibria=False)
    assert label_set(game, REQUEST, tmp_path) != label_set(game, best, tmp_path)
    assert torch.equal(start_states(game, REQUEST), start_states(game, best))
    assert "all_equilibria" not in label_set(game, best, tmp_path).provenance["request"]


@pytest.mark.parametrize(
    ("widen", "number", "shares"),
    [((1.0,), 5, [5]), ((1.0, 2.2), 6, [3, 3]), ((1.0, 2.2), 7, [4, 3]), ((1.0, 2.0, 3.0), 2, [1, 1, 0])],
)
def test_widths_share_the_trajectories(widen: tuple[float, ...], number: int, shares: list[int]) -> None:
    assert LabelPlan(widen=widen).shares(number) == shares


@pytest.mark.parametrize(("trajectories", "validation"), [(6, 2), (5, 3), (1, 1), (1, 4), (4, 1)])
@pytest.mark.parametrize("potential", [True, False])
def test_starts_come_from_every_box_and_some_of_each_are_held_out(
    tmp_path: Path, solved: list[Tensor], potential: bool, trajectories: int, validation: int
) -> None:
    game, types, widen = make("narrow_road"), [(1.0, 1.0), (2.0, 3.0)], (1.0, 2.2)
    plan = LabelPlan(types, trajectories, validation, widen, cache=tmp_path, workers=1)
    data = GameData(game, {"bvp"}, labels=plan, batch_sizes={"bvp": None}, potential=potential)
    data.setup("fit")
    trained, kept = plan.shares(trajectories), plan.shares(validation)
    asked = {(r.theta, r.widen): r for r in data.requests}
    for theta in types:
        for width, first, last in zip(widen, trained, kept, strict=True):
            request = asked.pop((theta, width), None)
            assert (request.starts if request else 0) == first + last
            assert request is None or (request.all_equilibria, request.split) == (potential, "train")
    assert not asked
    assert sum(found.starts for found in data.held_out()) == len(types) * validation
    assert all(len(found.start) == found.starts for found in data.held_out()), "validation plays the best ones"
    assert data.train_rows is not None
    starts = torch.cat([found.x[:, 0] for found in data.extremals])
    assert bool(game.initial_box.widened(2.2).contains(starts.float()).all())
    if trajectories > 1:
        assert not bool(game.initial_box.contains(starts.float()).all())
    rows, nodes = data.train_rows.size, len(data.extremals[0].t)
    if not potential:
        assert rows == len(types) * trajectories * nodes
    else:
        labels = data.train_rows.labels
        assert isinstance(labels, PotentialLabels)
        assert int(labels.best.sum()) == 2 * len(types) * trajectories * nodes, "of either order of the players"
        assert len(data.labelled.at(0)[1]) == rows + int(labels.best.sum())


def test_held_out_starts_are_not_trained_on_with_any_of_their_equilibria(solved: list[Tensor], tmp_path: Path) -> None:
    plan = LabelPlan([(1.0, 1.0)], 6, 3, (1.0, 2.2), cache=tmp_path, workers=1)
    data = GameData(make("narrow_road"), {"bvp"}, labels=plan, potential=True)
    data.setup("fit")
    trained, held_out = data.train_rows, data.val_rows
    assert trained is not None
    assert held_out is not None
    begins = [rows.points.x[rows.points.tau == data.game.horizon] for rows in (trained, held_out)]
    assert not bool((begins[0].unsqueeze(1) == begins[1]).all((-2, -1)).any())


def test_without_labels_nothing_is_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "labels_for", lambda *arguments: pytest.fail("labels were solved"))
    data = GameData(make("narrow_road"), {"interior"}, labels=LabelPlan(widen=(1.0, 2.2)), potential=True)
    if not data.needs_labels:
        data.setup("fit")
    assert data.held_out() == []


def test_the_shape_of_a_fake_with_several_equilibria_is_that_of_labels() -> None:
    found, plain = expected(5), fake_labels(make("narrow_road"))
    for name, ours, theirs in zip(Extremal._fields, found, plain, strict=True):
        assert ours.shape[1:] == theirs.shape[1:], name


def test_progress_counts_starts_not_equilibria(tmp_path: Path, solved: list[Tensor]) -> None:
    told: list[Progress] = []
    found, _ = labels_for(make("narrow_road"), [REQUEST], tmp_path, workers=1, report=told.append)
    assert len(found[0].status) > REQUEST.starts
    assert [progress.done for progress in told] == [0, 8, 16, 20]
    assert all(progress.converged == progress.done for progress in told)
