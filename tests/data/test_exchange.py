"""Labels as arrays, out and in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from hno.data import GameData, LabelPlan
from hno.data.exchange import REQUIRED, from_arrays, read_own, to_arrays, write_own
from hno.data.store import LabelFileError
from hno.games import Game, make
from hno.pontryagin.certificates import local_gap
from hno.pontryagin.collocation import Iterate
from hno.types import Extremal, Status


@pytest.fixture
def arrays(labels: Callable[..., Extremal]) -> dict[str, np.ndarray]:
    """What another program would hand over."""
    whole = to_arrays(labels("narrow_road"))
    return {name: whole[name].copy() for name in REQUIRED}


def test_what_comes_in_is_what_went_out(labels: Callable[..., Extremal], arrays: dict[str, np.ndarray]) -> None:
    ours, theirs = labels("narrow_road"), from_arrays(make("narrow_road"), arrays)
    for name in REQUIRED:
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name
    torch.testing.assert_close(theirs.u, ours.u, rtol=0, atol=1e-9)
    assert theirs.status.tolist() == [Status.CONVERGED] * len(ours.status)
    torch.testing.assert_close(theirs.potential, ours.potential, rtol=1e-3, atol=1e-3)
    assert theirs.start.tolist() == list(range(len(ours.status)))


def test_certificates_are_computed_and_tell_good_from_bad(arrays: dict[str, np.ndarray]) -> None:
    game = make("narrow_road")
    good = from_arrays(game, arrays)
    assert float(good.reintegration.max()) < 5e-3
    assert float(good.local_gap.max()) < 1e-2
    arrays["costate"] = arrays["costate"] * np.linspace(0, 1, len(arrays["t"])).reshape(1, -1, 1, 1, 1)
    bad = from_arrays(game, arrays)
    assert bool((bad.reintegration > 10 * good.reintegration).all())


def test_rows_beyond_a_chunk_are_certified_too(arrays: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    game = make("narrow_road")
    whole = from_arrays(game, arrays)
    sizes: list[int] = []

    def counted(game: Game, at: Iterate) -> torch.Tensor:
        sizes.append(len(at.t))
        return local_gap(game, at)

    monkeypatch.setattr("hno.data.exchange.CHUNK", 3)
    monkeypatch.setattr("hno.data.exchange.local_gap", counted)
    torch.testing.assert_close(from_arrays(game, arrays).local_gap, whole.local_gap, rtol=0, atol=1e-9)
    assert sizes == [3, 1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("costate"), "missing or unknown: costate"),
        (lambda a: a.update(reward=a["value"]), "missing or unknown: reward"),
        (lambda a: a.update(x=a["x"][:, :, :1]), "x must have shape"),
        (lambda a: a.update(value=-a["value"]), "value must end at"),
        (lambda a: a.update(costate=-a["costate"]), "costate must end at"),
        (lambda a: a.update(t=a["t"] * 2), "t must increase from 0 to the horizon"),
        (lambda a: a.update(t=a["t"][::-1].copy()), "t must increase from 0 to the horizon"),
        (lambda a: a["value"].__setitem__((0, 0, 0), np.nan), "value has entries that are not finite"),
        (lambda a: a.update({name: a[name][:0] for name in ("x", "costate", "value", "theta")}), "with rows"),
    ],
)
def test_arrays_that_are_no_labels_are_refused(
    arrays: dict[str, np.ndarray], change: Callable[[dict[str, np.ndarray]], object], message: str
) -> None:
    change(arrays)
    with pytest.raises(ValueError, match=message):
        from_arrays(make("narrow_road"), arrays)


def test_files_are_read_for_the_game_they_were_made_for(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    game, path = make("narrow_road"), tmp_path / "mine.safetensors"
    labels = from_arrays(game, arrays)
    write_own(path, game, labels, "a test")
    assert torch.equal(read_own(path, game).x, labels.x)
    with pytest.raises(LabelFileError, match="other physics"):
        read_own(path, make("narrow_road", radius=1.3))
    with pytest.raises(LabelFileError, match="NarrowRoad"):
        read_own(path, make("drone"))
    with pytest.raises(FileNotFoundError, match=r"no label file .*other\.safetensors"):
        read_own(tmp_path / "other.safetensors", game)


def own_data(path: Path, validation: int, cache: Path) -> GameData:
    plan = LabelPlan(trajectories=3, validation=validation, files=[path], cache=cache)
    return GameData(make("narrow_road"), ["bvp"], 0, plan, batch_sizes={"bvp": None})


def test_own_labels_alone_are_trained_on_and_held_out(
    tmp_path: Path, cache: Path, arrays: dict[str, np.ndarray]
) -> None:
    game, path = make("narrow_road"), tmp_path / "mine.safetensors"
    arrays["theta"] = arrays["theta"] * 0 + 1.5
    labels = from_arrays(game, arrays)
    write_own(path, game, labels, "a test")
    data = own_data(path, 1, cache)
    data.prepare_data()
    data.setup("fit")
    assert data.type_list == [(1.5, 1.5)]
    rows, nodes = len(labels.status), len(labels.t)
    assert (data.train_rows.size, data.val_rows.size) == ((rows - 1) * nodes, nodes)
    torch.testing.assert_close(data.train_rows.labels.value, labels.value[:-1].flatten(0, 1).float())
    with pytest.raises(ValueError, match=rf"mine\.safetensors holds {rows} labels and {rows} are held out"):
        own_data(path, rows, cache)
