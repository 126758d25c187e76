"""The film of a training: a frame at every validation."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lightning.pytorch.loggers import TensorBoardLogger

from hno.cli.film import Film
from hno.control import Feedback
from hno.control.slices import Slice
from hno.evaluation.film import FILM, FRAMES, POINTS, frames, keep, shot
from tests.operators.conftest import module_of, small_operator


@pytest.fixture(scope="module")
def found() -> Slice:
    return shot(Feedback(small_operator("narrow_road").requires_grad_(False)))


def trainer(step: int, loggers: list[Any], checking: bool = False) -> Any:
    return SimpleNamespace(global_step=step, loggers=loggers, sanity_checking=checking)


def test_frames_are_what_was_kept_in_the_order_of_steps(found: Slice, tmp_path: Path) -> None:
    for step in (100, 5):
        keep(found._replace(value=found.value * step), step, tmp_path)
    film = frames(tmp_path)
    assert film is not None
    assert [frame["step"] for frame in film["frames"]] == [5, 100]
    np.testing.assert_allclose(film["frames"][1]["values"], 100 * found.value.ravel(), rtol=1e-3)
    np.testing.assert_allclose(film["violation"], found.violation.ravel(), rtol=1e-3)


def test_many_frames_are_thinned_out_and_files_that_are_none_are_left_out(found: Slice, tmp_path: Path) -> None:
    for step in range(FRAMES + 15):
        keep(found, step, tmp_path)
    (tmp_path / FILM / "00000020.npz").write_bytes(b"PK damaged")
    np.savez(tmp_path / FILM / "00000021.npz", value=np.zeros((2, 2, 1)), violation=np.zeros((2, 2)))
    film = frames(tmp_path)
    assert film is not None
    steps = [frame["step"] for frame in film["frames"]]
    assert len(steps) == FRAMES
    assert (steps[0], steps[-1]) == (0, FRAMES + 14)
    assert not {20, 21} & set(steps)
    assert frames(tmp_path / "none") is None


def test_every_validation_is_a_frame_and_a_picture_where_dashboards_take_some(tmp_path: Path) -> None:
    logger, pictures = TensorBoardLogger(tmp_path), list[tuple[str, Any, int]]()

    def add_image(name: str, image: Any, step: int, dataformats: str) -> None:
        pictures.append((name, image, step))

    logger._experiment = SimpleNamespace(add_image=add_image)
    film, module = Film(tmp_path), module_of(small_operator("narrow_road"))
    film.on_validation_end(trainer(0, [logger], checking=True), module)
    for step in (3, 6):
        film.on_validation_end(trainer(step, [logger]), module)
    assert sorted(path.name for path in (tmp_path / FILM).iterdir()) == ["00000003.npz", "00000006.npz"]
    assert [(name, step) for name, _, step in pictures] == [("slice", 3), ("slice", 6)]
    image = pictures[0][1]
    assert image.ndim == 3
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > POINTS


def test_a_game_without_a_slice_has_no_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = module_of(small_operator("narrow_road"))
    monkeypatch.setattr(type(module.operator.game), "plane", None)
    monkeypatch.setattr(type(module.operator.game), "state_names", ("one",))
    film = Film(tmp_path)
    for step in (1, 2):
        film.on_validation_end(trainer(step, []), module)
    assert film.rests
    assert not (tmp_path / FILM).exists()
