from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.data.curriculum import Curriculum
from hno.data.datamodule import BOX_TYPES
from hno.data.sources import Known, Pool, make_sampler, onto_band, sample_points
from hno.games import Game, make
from hno.types import Trajectory
from tests.data.conftest import TYPES, MakeData

GAMES = ("narrow_road", "lane_change", "drone")
BASE = {"narrow_road": 1.25, "lane_change": 2.25, "drone": 0.5}
SOURCES = ("box", "band", "labels", "rollout")
ONLY = {name: dict.fromkeys(SOURCES, 0.0) | {name: 1.0} for name in SOURCES}


def radius(game: str, theta: Tensor) -> Tensor:
    """Collision radius as the paper states it, (B,)."""
    return BASE[game] + 0.1 * (theta[:, 0] + theta[:, 1]) + 0.05 * torch.minimum(theta[:, 0], theta[:, 1])


def distance(game: str, x: Tensor) -> Tensor:
    """Distance of the two players as the paper states it, (B,)."""
    first, second = x[:, 0], x[:, 1]
    if game == "drone":
        gaps = [5 - second[:, 0] - first[:, 0], 5 - second[:, 1] - first[:, 1], second[:, 2] - first[:, 2]]
    else:
        along = 70 - second[:, 0] - first[:, 0] if game == "narrow_road" else second[:, 0] - first[:, 0]
        gaps = [along, second[:, 1] - first[:, 1]]
    return torch.stack(gaps, -1).norm(dim=-1)


@pytest.mark.parametrize("name", GAMES)
@pytest.mark.parametrize("stream", ["bvp", "interior", "terminal"])
@pytest.mark.parametrize("types", ["labelled", "box"])
def test_collision_radius_of_a_row_is_that_of_its_own_theta(
    make_data: MakeData, name: str, stream: str, types: str
) -> None:
    """Published defect 1: a slicing slip took the radius of other rows."""
    game = make(name)
    points = make_data(game, interior_types=types).batch(9)[stream].points
    assert len(points.theta.unique(dim=0)) > 2
    own = game.constraint(points.x, points.theta)[..., 0] + distance(name, points.x).unsqueeze(-1)
    torch.testing.assert_close(own, radius(name, points.theta).unsqueeze(-1).expand(-1, 2), rtol=0, atol=2e-4)


@pytest.mark.parametrize("name", GAMES)
def test_band_lies_at_the_surface(make_data: MakeData, name: str) -> None:
    """Published defect 8: uniform collocation almost never meets the constraint."""
    game, sizes, share = make(name), {"bvp": 1, "interior": 2000, "terminal": 1}, {}
    for source in ("box", "band"):
        points = make_data(game, sampler=ONLY[source], batch_sizes=sizes).batch(9)["interior"].points
        gap = radius(name, points.theta) - distance(name, points.x)
        share[source] = float(((gap > -1.6) & (gap < 0.4)).float().mean())
    assert share["band"] > 0.5
    assert share["band"] > 10 * share["box"]


@pytest.mark.parametrize("name", GAMES)
def test_band_is_that_of_the_theta_of_each_row(make_data: MakeData, name: str) -> None:
    """With the radii of other rows the bands of small and large radii would lie at different gaps."""
    data = make_data(
        make(name), types=[(1.0, 1.0), (5.0, 5.0)], sampler=ONLY["band"],
        batch_sizes={"bvp": 1, "interior": 4000, "terminal": 1},
    )  # fmt: skip
    points = data.batch(9)["interior"].points
    gap = radius(name, points.theta) - distance(name, points.x)
    reached, small = (gap > -2.6) & (gap < 1.4), points.theta[:, 0] == 1
    assert abs(float(gap[reached & small].median() - gap[reached & ~small].median())) < 0.3


def test_band_spreads_over_its_width(make_data: MakeData) -> None:
    game, sizes = make("narrow_road"), {"bvp": 1, "interior": 2000, "terminal": 1}
    points = make_data(game, sampler=ONLY["band"], batch_sizes=sizes).batch(9)["interior"].points
    gap = game.constraint(points.x, points.theta).amax((-2, -1))
    assert float((gap < -1).float().mean()) > 0.1
    assert float((gap > 0).float().mean()) > 0.05


def test_onto_band_reaches_its_target() -> None:
    game, generator = make("lane_change"), torch.Generator().manual_seed(0)
    x, theta = game.state_box.sample(500, generator), game.type_box.sample(500, generator)
    target = torch.linspace(-1.5, 0.3, 500)
    gap = game.constraint(onto_band(game, x, theta, target), theta).amax((-2, -1)) - target
    assert float(gap.abs().median()) < 1e-3


@pytest.mark.parametrize("name", GAMES)
@pytest.mark.parametrize("source", SOURCES)
def test_points_stay_in_the_state_box(make_data: MakeData, name: str, source: str) -> None:
    game = make(name)
    batch = make_data(game, sampler=ONLY[source]).batch(5)
    for stream in ("interior", "terminal"):
        assert bool(game.state_box.contains(batch[stream].points.x).all())


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("step", [0, 3, 9, 50])
def test_interior_times_stay_in_the_window_and_fill_it(make_data: MakeData, source: str, step: int) -> None:
    data = make_data(sampler=ONLY[source], curriculum=Curriculum(0, 10))
    tau = data.batch(step)["interior"].points.tau
    reach = min(1.0, (step + 1) / 10) * data.game.horizon
    assert float(tau.min()) >= 0
    assert float(tau.max()) <= reach * (1 + 1e-6)
    assert float(tau.max()) > 0.8 * reach
    assert float(tau.min()) < 0.2 * reach


def test_terminal_points_are_at_the_end(make_data: MakeData) -> None:
    assert not make_data().batch(9)["terminal"].points.tau.any()


def test_labels_source_stays_near_labelled_states_of_that_time(make_data: MakeData) -> None:
    data = make_data(sampler=ONLY["labels"])
    points, rows, width = data.batch(4)["interior"].points, data.train_rows.points, data.game.state_box.width
    for tau, x in zip(points.tau, points.x, strict=True):
        states = rows.x[rows.tau == tau]
        assert len(states)
        assert float(((states - x) / width).abs().amax((-2, -1)).min()) < 0.05 * 5


def types_of(game: Game, make_data: MakeData, source: str) -> Tensor:
    sizes = {"bvp": 1, "interior": 500, "terminal": 1}
    return make_data(game, interior_types=source, batch_sizes=sizes).batch(9)["interior"].points.theta


def test_types_of_collocation_points(make_data: MakeData) -> None:
    game = make("narrow_road")
    labelled, box = types_of(game, make_data, "labelled"), types_of(game, make_data, "box")
    assert {tuple(theta) for theta in labelled.tolist()} == set(TYPES)
    assert bool(game.type_box.contains(box).all())
    assert len(box.unique(dim=0)) == BOX_TYPES
    assert float(box.min()) < 1.1
    assert float(box.max()) > 4.9


@pytest.mark.parametrize(
    "shares",
    [{"box": -0.1, "band": 1.0}, {"box": 0.0}, {"box": math.nan}, {"box": math.inf, "band": 1.0}, {"box": "half"}, {}],
)
def test_impossible_shares_are_refused(shares: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="must be finite, not negative and not all 0; got "):
        make_sampler(shares)


@pytest.mark.parametrize("name", SOURCES)
def test_every_source_can_stand_alone(name: str) -> None:
    for shares in ({name: 0.1}, ONLY[name]):
        assert list(make_sampler(shares)) == [name]


def test_shares_are_shares_in_any_unit(make_data: MakeData) -> None:
    parts = [make_data(sampler={"box": unit, "labels": 3 * unit}).batch(9)["interior"].points for unit in (0.25, 100)]
    assert torch.equal(parts[0].x, parts[1].x)
    sampler, game, theta = make_sampler({"box": 1, "labels": 3}), make("narrow_road"), torch.ones(4000, 2)
    pool = Pool(torch.full((1,), 0.5), game.state_box.lo.unsqueeze(0))
    drawn = sample_points(game, theta, sampler, Known(pool, None), 1.0, torch.Generator().manual_seed(0))
    assert float((drawn.tau == 0.5).float().mean()) == pytest.approx(0.75, abs=0.03)


def test_options_of_a_source_stand_beside_its_share() -> None:
    game, theta = make("narrow_road"), torch.ones(2000, 2)
    near, spreads = [], []
    for reach, spread in ((0.5, 0.01), (3.0, 0.1)):
        sampler = make_sampler({"band": {"share": 2, "reach": reach}, "labels": {"share": 0.0, "spread": spread}})
        assert list(sampler) == ["band"]
        points = sample_points(game, theta, sampler, Known(None, None), 1.0, torch.Generator().manual_seed(0))
        gap = game.constraint(points.x, theta).amax(-1)
        near.append(float(((gap > -0.55) & (gap < 0.15)).float().mean()))
        around = make_sampler({"labels": {"share": 1, "spread": spread}})
        middle = (game.state_box.lo + game.state_box.hi) / 2
        pool = Known(Pool(torch.zeros(1), middle.unsqueeze(0)), None)
        points = sample_points(game, theta, around, pool, 1.0, torch.Generator().manual_seed(0))
        spreads.append(float(((points.x - middle) / game.state_box.width).std()))
    assert near[0] > 3 * near[1] > 0, "constraint values lie in [-reach, 0.2 reach]"
    assert spreads == pytest.approx([0.01, 0.1], rel=0.05)


@pytest.mark.parametrize(("name", "option"), [("band", "reach"), ("labels", "spread"), ("rollout", "spread")])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_impossible_options_of_a_source_are_refused(name: str, option: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"sampler.{name}.{option} must be a"):
        make_sampler({name: {"share": 1.0, option: value}})


def played(game: Game, seed: int = 0, episodes: int = 3, steps: int = 10) -> Trajectory:
    """Episodes through random states; every one of them tells which time it belongs to."""
    t = torch.linspace(0, game.horizon, steps + 1)
    x = game.state_box.sample(episodes * len(t), torch.Generator().manual_seed(seed)).unflatten(0, (episodes, len(t)))
    one = torch.ones(episodes)
    return Trajectory(t, x, x[:, 1:, :, : game.control_dim], one.expand(2, -1).mT, one, one)


def times_of(game: Game, episodes: Trajectory) -> Tensor:
    return (game.horizon - episodes.t).expand(len(episodes.x), -1)


@pytest.mark.parametrize("name", GAMES)
def test_rollout_source_stays_near_visited_states_of_that_time(make_data: MakeData, name: str) -> None:
    game = make(name)
    data, episodes = make_data(game, sampler=ONLY["rollout"]), played(game)
    data.visit(episodes)
    times = times_of(game, episodes)
    points = data.batch(4)["interior"].points
    assert len(points.tau.unique()) > 3
    for tau, x in zip(points.tau, points.x, strict=True):
        states = episodes.x[times == tau]
        assert len(states) == 3
        assert float(((states - x) / game.state_box.width).abs().amax((-2, -1)).min()) < 0.05 * 5
    spread = ((points.x[:, None] - episodes.x.flatten(0, 1)) / game.state_box.width).abs().amax((-2, -1)).amin(-1)
    assert float(spread.median()) > 0.01, "points lie around visited states, not on them"


def test_only_the_latest_episodes_are_drawn_from(make_data: MakeData) -> None:
    data = make_data(sampler=ONLY["rollout"])
    game, seen = data.game, []
    for seed in (0, 1):
        episodes = played(game, seed)
        data.visit(episodes)
        assert data.visits
        assert torch.equal(data.visits[-1].tau, times_of(game, episodes).flatten())
        assert torch.equal(data.visits[-1].x, episodes.x.flatten(0, 1))
        seen.append(data.batch(4)["interior"].points.x)
    assert not torch.equal(*seen)


def test_before_any_validation_the_policy_is_where_the_labels_are(make_data: MakeData) -> None:
    data = make_data(sampler=ONLY["rollout"])
    assert not data.visits
    points, rows, width = data.batch(4)["interior"].points, data.train_rows.points, data.game.state_box.width
    for tau, x in zip(points.tau, points.x, strict=True):
        states = rows.x[rows.tau == tau]
        assert len(states)
        assert float(((states - x) / width).abs().amax((-2, -1)).min()) < 0.05 * 5


def test_visits_touch_nothing_but_their_own_share(make_data: MakeData) -> None:
    shares = dict.fromkeys(SOURCES, 1.0)
    before, after = make_data(sampler=shares), make_data(sampler=shares)
    after.visit(played(after.game))
    old, new = before.batch(8), after.batch(8)
    assert torch.equal(old["bvp"].points.x, new["bvp"].points.x)
    same = (old["interior"].points.x == new["interior"].points.x).flatten(1).all(-1)
    assert 0.5 < float(same.float().mean()) < 1
    assert torch.equal(old["interior"].points.theta, new["interior"].points.theta)


def test_states_that_are_not_finite_are_not_visited(make_data: MakeData) -> None:
    data = make_data(sampler=ONLY["rollout"])
    episodes = played(data.game)
    x = episodes.x.clone()
    x[0, 4:], x[1, 7:, 1, 2] = torch.nan, torch.inf
    data.visit(episodes._replace(x=x))
    assert data.visits
    _, times, states = data.visits[-1]
    assert len(times) == len(states) == 33 - 7 - 4
    assert bool(states.isfinite().all())
    for tau, state in zip(times, states, strict=True):
        assert bool((state == episodes.x[times_of(data.game, episodes) == tau]).flatten(1).all(-1).any())
    data.visit(episodes._replace(x=torch.full_like(x, torch.nan)))
    assert torch.equal(data.visits[-1].x, states), "an episode without a finite state leaves the older ones"


@pytest.mark.parametrize("step", [0, 3])
def test_a_policy_that_breaks_at_its_start_leaves_points_to_draw(make_data: MakeData, step: int) -> None:
    """Controls that are not finite: of every episode, only the start is, which the window does not reach yet."""
    data = make_data(sampler=ONLY["rollout"], curriculum=Curriculum(0, 10))
    episodes = played(data.game)
    x = episodes.x.clone()
    x[:, 1:] = torch.nan
    data.visit(episodes._replace(x=x))
    points = data.batch(step)["interior"].points
    assert bool(points.x.isfinite().all())
    assert float(points.tau.max()) <= (step + 1) / 10 * data.game.horizon * (1 + 1e-6)


def test_visits_survive_a_checkpoint(make_data: MakeData) -> None:
    data, resumed, fresh = (make_data(sampler=ONLY["rollout"]) for _ in range(3))
    assert data.state_dict() == {"visits": [], "added": []}
    data.visit(played(data.game))
    resumed.load_state_dict(data.state_dict())
    fresh.load_state_dict({"visits": [], "added": []})
    for batch in (resumed.batch(6), resumed.batch(6)):
        assert torch.equal(batch["interior"].points.x, data.batch(6)["interior"].points.x)
    assert not fresh.visits
    assert not torch.equal(fresh.batch(6)["interior"].points.x, data.batch(6)["interior"].points.x)
