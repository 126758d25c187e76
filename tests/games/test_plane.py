"""Coordinates by name, and the plane that pictures of a game show first."""

from __future__ import annotations

import pytest
import torch

from hno.control.slices import chosen_plane, grid, middle_types
from hno.games import Axis, Plane, games, make
from hno.games.narrow_road import NarrowRoad
from tests.walkers import Walkers

OWN = ("narrow_road", "lane_change", "drone", "intersection")


def test_every_game_of_the_package_is_asked_about() -> None:
    assert {name for name in games.names() if games.get(name).__module__.startswith("hno.")} == set(OWN)


@pytest.mark.parametrize("name", OWN)
def test_a_coordinate_is_put_where_it_is_wanted_and_moves_no_other_one(name: str) -> None:
    game = make(name)
    x = game.state_box.sample(3, torch.Generator().manual_seed(0)).double()
    known = game.coordinates().values()
    for one in known:
        moved = one.put(x, one.hi)
        torch.testing.assert_close(one.of(moved), torch.full((3,), one.hi, dtype=x.dtype))
        for other in known:
            if float((one.weights * other.weights).sum()) == 0:
                torch.testing.assert_close(other.of(moved), other.of(x))


@pytest.mark.parametrize("name", OWN)
def test_coordinates_span_the_pde_box(name: str) -> None:
    game = make(name)
    x = game.state_box.sample(200, torch.Generator().manual_seed(1)).double()
    for one in game.coordinates().values():
        assert bool(((one.lo <= one.of(x)) & (one.of(x) <= one.hi)).all())


@pytest.mark.parametrize("name", ["narrow_road", "lane_change", "drone"])
def test_relative_coordinates_are_the_way_from_player_1_to_player_2(name: str) -> None:
    game = make(name)
    x = game.state_box.sample(5, torch.Generator().manual_seed(2))
    one, other = game.positions(x).double().unbind(1)
    found = torch.stack([game.coordinate(relative).of(x.double()) for relative in game.relative_names], -1)
    torch.testing.assert_close(found, other - one, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("name", OWN)
def test_the_first_plane_of_a_game_shows_its_collision_set(name: str) -> None:
    game = make(name)
    x = grid(game, chosen_plane(game, None, None, None), 21).x.float()
    theta = torch.tensor(middle_types(game)).expand(*x.shape[:2], -1)
    inside = game.violates(x.flatten(0, 1), theta.flatten(0, 1)).float().mean()
    assert 0 < float(inside) < 0.5
    box = game.state_box.widened(1.001)
    assert bool(box.contains(x).all())


def test_a_game_from_outside_has_names_and_a_plane_without_saying_anything() -> None:
    game = Walkers()
    assert list(game.coordinates())[: game.state_dim] == [f"x{place}_1" for place in range(game.state_dim)]
    plane = game.default_plane()
    assert (plane.across, plane.up) == (Axis("x0_1"), Axis("x0_2"))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"state_names": ("px", "py")}, "has 4 states per player: state_names and state_units must have as many"),
        ({"relative_names": ("gap",)}, "one name for each of the 2 components of positions"),
    ],
)
def test_names_that_do_not_fit_are_refused(names: dict[str, tuple[str, ...]], message: str) -> None:
    game = make("narrow_road")
    for name, value in names.items():
        object.__setattr__(game, name, value)
    with pytest.raises(ValueError, match=message):
        game.coordinates()


def test_positions_that_are_not_affine_have_no_relative_coordinates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(NarrowRoad, "positions", lambda self, x: x[..., :2].square())
    with pytest.raises(ValueError, match="affine functions of the state"):
        make("narrow_road").coordinates()


def test_an_unknown_coordinate_is_one_error_that_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"no coordinate 'gab'\. Did you mean 'gap'\? It has px_1, py_1, .*offset"):
        make("narrow_road").coordinate("gab")


def test_a_plane_may_place_other_coordinates(monkeypatch: pytest.MonkeyPatch) -> None:
    game = make("narrow_road")
    monkeypatch.setattr(NarrowRoad, "plane", Plane(Axis("gap", 0, 10), Axis("offset", -1, 1), {"v_1": 25.0}))
    x = grid(game, chosen_plane(game, None, None, {"v_2": 19.0}), 2).x
    assert set(x[..., 3].reshape(-1, 2).unique(dim=0).flatten().tolist()) == {25.0, 19.0}
