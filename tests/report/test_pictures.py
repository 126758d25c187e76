from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from matplotlib.animation import FuncAnimation
from matplotlib.figure import Figure
from PIL import Image

from hno.report.collision_map import collision_map
from hno.report.gif import animate
from hno.report.picture import PlotsMissingError
from tests.report.tables import episode, type_row

TABLE = [type_row((1, 1), 0, 200), type_row((1, 5), 10, 200, seen=False), type_row((5, 1), 0, 0)]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[list[dict[str, Any]]], Figure]:
    """The figure that a map is saved from."""

    def draw(table: list[dict[str, Any]]) -> Figure:
        kept: list[Figure] = []
        with monkeypatch.context() as patch:
            patch.setattr(Figure, "savefig", lambda self, *_, **__: kept.append(self))
            collision_map(table, tmp_path / "map.png", "a game")
        return kept[0]

    return draw


def test_every_cell_says_its_rate_and_its_number_of_starts(drawn: Callable[..., Figure]) -> None:
    axes = drawn(TABLE).axes[0]
    cells = {text.get_position(): text.get_text() for text in axes.texts}
    assert cells == {(0, 0): "0 %\nof 200", (0, 1): "5 %\nof 200", (1, 0): "n/a\nof 0"}
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1", "5"]


def test_seen_types_are_framed_and_colours_follow_the_rate(drawn: Callable[..., Figure]) -> None:
    safe, unsafe, unknown = drawn(TABLE).axes[0].patches
    assert [patch.get_linewidth() > 1 for patch in (safe, unsafe, unknown)] == [True, False, True]
    brightness = [sum(patch.get_facecolor()[:3]) for patch in (safe, unsafe)]
    assert brightness[0] > brightness[1]
    assert len(set(unknown.get_facecolor()[:3])) == 1, "grey: neither safe nor unsafe"


@pytest.mark.parametrize("table", [[], [type_row((1, 1, 1), 0, 9)]])
def test_a_map_needs_two_players_and_rows(table: list[dict[str, Any]], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="two players"):
        collision_map(table, tmp_path / "map.png", "a game")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("dimensions", [2, 3])
def test_an_animation_has_a_frame_for_each_time_and_they_differ(dimensions: int, tmp_path: Path) -> None:
    animate(episode((1, 5), 0.3, dimensions), tmp_path / "worst.gif", "a game")
    with Image.open(tmp_path / "worst.gif") as image:
        assert image.n_frames == 4
        frames = []
        for index in range(4):
            image.seek(index)
            frames.append(image.convert("RGB").tobytes())
    assert len(set(frames)) == 4
    assert image.info["duration"] == 500, "as fast as the episode: two frames a second"


def test_frames_show_the_time_and_the_paths_so_far(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[tuple[str, list[int], list[float]]] = []

    def look(self: Any, *_: object, **__: object) -> None:
        self._draw_was_started = True  # it would warn otherwise
        for frame in self.new_frame_seq():
            self._func(frame)
            axes = self._fig.axes[0]
            lengths = [len(line.get_xdata()) for line in axes.lines]
            seen.append((self._fig.get_suptitle(), lengths, [disc.radius for disc in axes.patches]))

    monkeypatch.setattr(FuncAnimation, "save", look)
    animate(episode((1, 5), 0.3, frames=3), tmp_path / "worst.gif", "a game")
    assert seen == [(f"a game, t = {0.5 * k:.2f} s", [k + 1] * 2, [0.75] * 2) for k in range(3)]


def test_without_matplotlib_the_remedy_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for module in ("matplotlib.figure", "matplotlib.colors", "matplotlib.animation"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(PlotsMissingError, match=r"hno\[plots\]"):
        collision_map(TABLE, tmp_path / "map.png", "a game")
    with pytest.raises(PlotsMissingError, match=r"hno\[plots\]"):
        animate(episode((1, 5), 0.3), tmp_path / "worst.gif", "a game")
