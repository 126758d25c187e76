"""As many labels as it takes until enough of them are safe."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hno.data import labels as label_data
from hno.data import shards
from hno.data.certificates import CLEARANCE, safe
from hno.data.labels import Progress, Request, label_set, labels_for, safe_labels_for, start_states
from hno.games import Game, make
from hno.pontryagin.solve import Solver
from hno.types import Extremal, Status
from tests.fakes import fake_solve

REQUEST = Request((1.0, 5.0), 9, 0, "test")
RARE = Request((5.0, 5.0), 9, 0, "test")

Asked = list[Tensor]
"""Start states of every call of the solver."""


def draw(x0: Tensor) -> Tensor:
    """A number in [0, 1) that belongs to each start state."""
    return (1e3 * x0.flatten(1).sum(-1)) % 1


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    """Starts are safe by chance: 40 % of them at (1, 5), 8 % at (5, 5), none at (3, 3); some are not solved."""
    calls: Asked = []
    shares = {(1.0, 5.0): 0.4, (5.0, 5.0): 0.08, (3.0, 3.0): 0.0, (2.0, 2.0): 1.0}

    def answer(game: Game, x0: Tensor, theta: Tensor, settings: Solver, *, all_equilibria: bool) -> Extremal:
        calls.append(x0)
        chance, share = draw(x0), shares[tuple(theta[0].tolist())]
        clearance = torch.where(chance < share, 2 * CLEARANCE, torch.where(chance < share + 0.1, CLEARANCE / 2, -0.1))
        stalled = (chance < share) & (chance > 0.9 * share) & (share < 1)
        status = torch.where(stalled, int(Status.STALLED), int(Status.CONVERGED))
        return fake_solve(game, x0, theta)._replace(clearance=clearance, status=status)

    monkeypatch.setattr(label_data, "solve", answer)
    for module in (label_data, shards):
        monkeypatch.setattr(module, "SHARD", 8)
    return calls


def bits(labels: Extremal) -> list[bytes]:
    return [tensor.numpy().tobytes() for tensor in labels]


Safe = Callable[..., Extremal]


@pytest.fixture
def found(tmp_path: Path, asked: Asked) -> Safe:
    """Safe labels of one request."""

    def solve(request: Request, cache: Path = tmp_path, **options: int) -> Extremal:
        return safe_labels_for(make("narrow_road"), [request], cache, workers=1, **options)[0][0]

    return solve


@pytest.mark.parametrize("request_", [REQUEST, RARE])
@pytest.mark.parametrize("wanted", [1, 2, 9, 30])
def test_as_many_safe_starts_as_asked_for(found: Safe, request_: Request, wanted: int) -> None:
    labels = found(request_._replace(starts=wanted))
    mask = safe(labels)
    assert int(mask.sum()) == wanted
    assert bool(mask[-1]), "no row after the last one that was asked for"
    assert not bool(mask.all()), "unsafe starts among them stay, so that they can be counted"


def test_they_are_the_first_of_the_set(found: Safe, tmp_path: Path) -> None:
    labels = found(REQUEST)
    count = len(labels.status)
    assert torch.equal(labels.x[:, 0], start_states(make("narrow_road"), REQUEST._replace(starts=count)))
    (plain,), _ = labels_for(make("narrow_road"), [REQUEST._replace(starts=count)], tmp_path, workers=1)
    assert bits(plain) == bits(labels)


def test_fewer_are_a_prefix_of_more(found: Safe) -> None:
    sets = [found(REQUEST._replace(starts=wanted)) for wanted in (3, 30, 12, 30)]
    longest = sets[1]
    for labels in sets:
        count = len(labels.status)
        assert torch.equal(labels.x, longest.x[:count])
        assert torch.equal(labels.clearance, longest.clearance[:count])
    assert bits(sets[3]) == bits(sets[1])


def test_the_result_does_not_depend_on_how_the_set_grew(found: Safe, tmp_path: Path) -> None:
    at_once = bits(found(REQUEST._replace(starts=25), tmp_path / "once"))
    for wanted in (1, 2, 25):
        grown = found(REQUEST._replace(starts=wanted), tmp_path / "grown")
    assert bits(grown) == at_once
    labels_for(make("narrow_road"), [REQUEST._replace(starts=200)], tmp_path / "large", workers=1)
    assert bits(found(REQUEST._replace(starts=25), tmp_path / "large")) == at_once


def test_the_result_does_not_depend_on_the_size_of_shards(
    found: Safe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = []
    for size in (3, 8, 64):
        for module in (label_data, shards):
            monkeypatch.setattr(module, "SHARD", size)
        results.append(bits(found(REQUEST, tmp_path / str(size))))
    assert results[0] == results[1] == results[2]


def test_the_result_does_not_depend_on_the_other_requests(tmp_path: Path, asked: Asked, found: Safe) -> None:
    game, sizes = make("narrow_road"), (12, 3, 5)
    requests = [Request(theta, n, 0, "test") for theta, n in zip(((1, 5), (5, 5), (2, 2)), sizes, strict=True)]
    together, seconds = safe_labels_for(game, requests, tmp_path / "together", workers=1)
    alone = [found(request, tmp_path / "alone") for request in requests]
    assert [bits(labels) for labels in together] == [bits(labels) for labels in alone]
    assert [int(safe(labels).sum()) for labels in together] == list(sizes)
    assert seconds > 0


def test_no_start_is_solved_twice(found: Safe, asked: Asked) -> None:
    found(RARE)
    states = torch.cat(asked).flatten(1)
    assert len(states.unique(dim=0)) == len(states)
    calls = len(asked)
    found(RARE)
    assert len(asked) == calls


def test_where_every_start_is_safe_no_other_is_solved(found: Safe, asked: Asked) -> None:
    labels = found(Request((2.0, 2.0), 9, 0, "test"))
    assert len(labels.status) == 9
    assert sum(map(len, asked)) == 9


def test_the_search_looks_no_further_than_it_has_to(found: Safe, asked: Asked) -> None:
    """It guesses how many it takes from the share so far, and may overshoot by a little more than a shard."""
    labels = found(REQUEST._replace(starts=30))
    assert sum(map(len, asked)) < 1.6 * len(labels.status) + 8


@pytest.mark.parametrize("most", [9, 20, 40])
def test_the_search_ends_somewhere(found: Safe, asked: Asked, most: int) -> None:
    labels = found(Request((3.0, 3.0), 9, 0, "test"), most=most)
    assert len(labels.status) == most
    assert sum(map(len, asked)) == most
    assert not bool(safe(labels).any())


def test_fewer_safe_starts_than_asked_for_come_with_every_row(found: Safe) -> None:
    labels = found(RARE._replace(starts=8), most=40)
    mask = safe(labels)
    assert len(labels.status) == 40
    assert 0 < int(mask.sum()) < 8
    whole = found(RARE._replace(starts=8))
    assert int(safe(whole).sum()) == 8
    assert torch.equal(whole.x[:40], labels.x)


def test_what_is_asked_for_outright_is_not_capped(found: Safe) -> None:
    """The cap is on the search: 9 starts are 9 starts."""
    labels = found(RARE, most=4)
    assert len(labels.status) == 9


def test_a_start_that_is_not_solved_is_not_safe(found: Safe) -> None:
    labels = found(REQUEST._replace(starts=30))
    stalled = labels.status == Status.STALLED
    assert bool((stalled & (labels.clearance >= CLEARANCE)).any())
    assert int(((labels.clearance >= CLEARANCE) & ~stalled).sum()) == 30


def test_progress_is_told_while_the_set_grows(tmp_path: Path, asked: Asked) -> None:
    told: list[Progress] = []
    labels = safe_labels_for(make("narrow_road"), [RARE], tmp_path, workers=1, report=told.append)[0][0]
    assert sum(len(x0) for x0 in asked) >= len(labels.status)
    assert told[:2] == [(0, 9, 0), (8, 9, told[1].converged)]
    solved = [progress for progress in told if progress.done]
    assert all(progress.done <= progress.total for progress in solved)
    assert len(solved) == len(asked)


def test_the_manifest_covers_what_was_solved(found: Safe, asked: Asked, tmp_path: Path) -> None:
    found(RARE)
    rows = sum(map(len, asked))
    assert len(label_set(make("narrow_road"), RARE, tmp_path).read(rows).status) == rows
