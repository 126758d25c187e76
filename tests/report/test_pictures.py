from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from hno.report import pictures, vega
from hno.report.episode import episode as read
from hno.report.pictures import collision_map, rollout_picture
from tests.report.tables import episode, type_row

TABLE = [type_row((1, 1), 0, 200), type_row((1, 5), 10, 200, seen=False), type_row((5, 1), 0, 0)]


def drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, table: list[dict[str, Any]]) -> ET.Element:
    """The map as SVG."""
    kept: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(vega, "png", lambda chart, *_: kept.append(vega.svg(chart)) or b"")
        collision_map(table, tmp_path / "map.png", "a game")
    return ET.fromstring(kept[0])


def test_every_cell_says_its_rate_and_the_title_the_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    texts = [text for text in drawn(monkeypatch, tmp_path, TABLE).itertext() if text.strip()]
    assert {"0", "5.0", "n/a", "a game", "10 of 400: 2.50 %", "0 to 200 safe starts per type"} <= set(texts)


def rectangles(found: ET.Element) -> list[dict[str, str]]:
    places = (path.attrib for path in found.iter() if path.tag.endswith("path"))
    return [place for place in places if place.get("d", "").count("A") + place.get("d", "").count("C") >= 4]


def test_seen_types_are_framed_and_colours_follow_the_rate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    worse = [*TABLE[:2], type_row((5, 1), 150, 200, seen=False)]
    few, more = (rectangles(drawn(monkeypatch, tmp_path, table)) for table in (TABLE, worse))
    framed = [place for place in few if place.get("stroke-width") == "2"]
    assert len(framed) == sum(row["seen"] for row in TABLE) == 2
    assert len({place["fill"] for place in more if place.get("fill", "").startswith(("#", "rgb"))}) >= 3


@pytest.mark.parametrize("table", [[], [type_row((1, 1, 1), 0, 9)]])
def test_a_map_needs_two_players_and_rows(table: list[dict[str, Any]], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="two players"):
        collision_map(table, tmp_path / "map.png", "a game")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_rollout_has_a_view_for_every_plane_and_the_distance(
    dimensions: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[str] = []
    png = vega.png
    monkeypatch.setattr(vega, "png", lambda chart: kept.append(vega.svg(chart)) or png(chart))
    rollout_picture(read(episode((1, 5), 0.3, dimensions)), tmp_path / "rollout.png", "a game")
    axes = [[text for text in ET.fromstring(found).itertext() if text.endswith(("[m]", "[s]"))] for found in kept]
    assert axes == [["x [m]", "y [m]"], ["x [m]", "z [m]"], ["t [s]", "distance [m]"]][: dimensions - 1] + axes[-1:]
    assert axes[-1] == ["t [s]", "distance [m]"]
    assert "a game" in kept[0]


def test_a_view_shows_paths_up_to_its_frame_and_discs_that_turn_red() -> None:
    found = read(episode((1, 5), -0.3, frames=5))
    shown = [vega.svg(pictures.views(found, frame, False, "")["top"]) for frame in (0, 4)]
    paths = [
        max(len(path.get("d", "").split("L")) for path in ET.fromstring(text).iter() if path.tag.endswith("path"))
        for text in shown
    ]
    assert paths[0] < paths[1]


def test_a_diamond_marks_where_another_branch_is_played(tmp_path: Path) -> None:
    def diamonds(branch: list[int] | None) -> int:
        (top,) = pictures.views(read(episode((1, 5), 0.3) | {"branch": branch}), 3, False, "a game").values()
        (tmp_path / "top.svg").write_text(vega.svg(top))
        paths = (mark.get("d", "") for mark in ET.parse(tmp_path / "top.svg").iter() if mark.tag.endswith("path"))
        return sum(path.count("L") == 3 and path.endswith("Z") for path in paths)

    without = diamonds(None)
    found = [diamonds(branch) - without for branch in ([0, 0, 0, 0], [0, 1, 1, 1], [0, 1, 0, 0])]
    assert found == [0, 2, 4]


@pytest.mark.parametrize(("players", "radius"), [(1, None), (2, None), (2, 1.5), (3, 1.5)])
def test_a_rollout_is_drawn_for_any_number_of_players(players: int, radius: float | None, tmp_path: Path) -> None:
    found = episode((1, 5), 0.3)
    found["positions"] = [[*places, [0.0, 9.0]][-players:] for places in found["positions"]]
    found["radius"] = None if radius is None else [radius] * 4
    rollout_picture(read(found), tmp_path / "rollout.png", "a game")
    with Image.open(tmp_path / "rollout.png") as image:
        colors = image.convert("RGB").getcolors(1 << 24)
    assert colors is not None
    assert len(colors) > 50, "more than an empty frame"
