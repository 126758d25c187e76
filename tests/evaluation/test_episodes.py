from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from hno.control.belief import Believing
from hno.control.rollout import Player
from hno.evaluation.closed_loop import play
from hno.evaluation.episodes import FRAMES, episodes, together, write_paths
from hno.evaluation.outcome import numbers_of, outcome
from hno.games import Game, make
from hno.games.kinematics import separation
from hno.types import Extremal, Points, PotentialField, Trajectory
from tests.fakes import Controller, evaluation_of, fake_labels
from tests.lq import LinearQuadratic
from tests.walkers import Walkers


def straight(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
    """Walk along x at 4 m/s: walkers who start at the same height miss each other by twice that."""
    return torch.tensor([4.0, 0.0]).expand(len(x), 2, 2)


def kept_of(
    game: Game, policy: Player, labels: Sequence[Extremal], change: Callable[..., Any] = zip, **entries: Any
) -> dict[str, Any]:
    """The file of the episodes from the starts of labels, whose labels and paths are changed before."""
    evaluation = evaluation_of(game, policy, labels, **entries)
    found, paths = zip(*play(game, evaluation.policy, labels, evaluation.dt), strict=True)
    return together(game, [one for pair in change(found, paths) for one in episodes(evaluation, *pair)])


def labelled(heights: list[float], clearance: list[float], theta: float) -> Extremal:
    x0 = torch.tensor([[[0.0, y], [0.0, y]] for y in heights])
    return fake_labels(Walkers(), (theta, theta), len(heights), 0, None, clearance, x0)


@pytest.fixture
def sets() -> list[Extremal]:
    """Three types; of the first, the row with the smallest distance does not count; of the last, none does."""
    return [
        labelled([0.0, 0.9, 0.4, 0.05, 0.5], [0.0, 0.5, 0.5, 0.5, 0.5], 1.0),
        labelled([0.8, 0.35, 0.7], [0.5, 0.5, 0.5], 2.0),
        labelled([0.1], [-0.5], 3.0),
    ]


def test_the_worst_lost_most_and_the_typical_has_a_median_equilibrium(sets: list[Extremal]) -> None:
    """Distances are 1.8, 0.8, 0.1, 1.0 and 1.6, 0.7, 1.4; the radius of a type is 0.2 + 0.2 theta.

    Where one collides it is the worst, whatever it costs; where none does it is the one with the largest excess cost,
    whether or not players come close.
    """
    game = Walkers()
    kept = kept_of(game, straight, sets)
    assert (kept["players"], kept["dimensions"]) == (2, 2)
    found = [(e["theta"][0], e["kind"], e["collided"], e["start"].split("/")[1]) for e in kept["episodes"]]
    (_, first), (_, second) = ((found, paths) for found, paths in play(game, straight, sets[:2], 0.02))
    lost = second.cost - sets[1].cost.float()
    medians = [
        int(one.cost[keep].argsort()[len(keep) // 2])
        for one, keep in zip(sets, ([1, 2, 3, 4], [0, 1, 2]), strict=False)
    ]
    assert bool(first.collided[3])
    assert not second.collided.any()
    assert found == [
        (1.0, "worst", True, "3"),
        (1.0, "typical", bool(first.collided[1 + medians[0]]), str(1 + medians[0])),
        (2.0, "worst", False, str(int(lost.argmax()))),
        (2.0, "typical", False, str(medians[1])),
    ]
    assert all(radius == pytest.approx(0.4, abs=1e-3) for radius in kept["episodes"][0]["radius"])


def test_policies_that_play_the_same_starts_have_episodes_of_the_same_ones(sets: list[Extremal]) -> None:
    def aside(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return torch.tensor([3.0, 0.2]).expand(len(x), 2, 2)

    def kept(policy: Player, also: Sequence[int]) -> list[Any]:
        evaluation = evaluation_of(Walkers(), policy, sets)
        return episodes(evaluation, *next(play(Walkers(), policy, sets, 0.02)), also)

    first = kept(straight, ())
    second = kept(aside, [one.row for one in first])
    assert {one.content["start"] for one in first} <= {one.content["start"] for one in second}
    assert len({one.row for one in second}) == len(second) or second[0].row == second[1].row


def test_states_controls_and_values_are_kept_at_every_step(sets: list[Extremal], tmp_path: Path) -> None:
    evaluation = evaluation_of(Walkers(), straight, sets)
    label, played = next(play(Walkers(), straight, sets, 0.02))
    kept = episodes(evaluation, label, played)
    write_paths(kept, tmp_path / "paths.safetensors")
    found = load_file(tmp_path / "paths.safetensors")
    for k, one in enumerate(kept):
        torch.testing.assert_close(found[f"{k}.x"], played.x[one.row])
        torch.testing.assert_close(found[f"{k}.u"], played.u[one.row])
        assert found[f"{k}.value"].shape == (len(played.t), 2)
        torch.testing.assert_close(found[f"{k}.label_x"], label.x[one.row].float())
        frames = len(one.content["t"])
        assert [len(one.content[name]) for name in ("speed", "controls", "value")] == [frames] * 3
        assert torch.tensor(one.content["speed"]).sub(4.0).abs().max() < 1e-2, "they walk at 4 m/s"


def test_an_episode_shows_where_players_go_and_where_the_equilibrium_goes(sets: list[Extremal]) -> None:
    game = Walkers()
    _, played = next(play(game, straight, sets, 0.02))
    episode = kept_of(game, straight, sets)["episodes"][0]
    frames = len(episode["t"])
    assert FRAMES / 2 < frames <= FRAMES + 2
    kept = separation(torch.tensor(episode["positions"])).amin(-1)
    assert episode["start"].endswith("/3")
    assert float(kept.min()) == pytest.approx(float(separation(game.positions(played.x[3])).min()), abs=2e-3)
    assert (episode["t"][0], episode["t"][-1]) == (0.0, pytest.approx(game.horizon))
    for name in ("positions", "label_positions"):
        assert torch.tensor(episode[name]).shape == (frames, 2, 2)
    torch.testing.assert_close(torch.tensor(episode["positions"][0]), game.positions(played.x[3, 0]), atol=1e-3, rtol=0)
    assert episode["cost"] == pytest.approx(-float(played.value[3].sum()), abs=1e-3)
    assert episode["label_cost"] == pytest.approx(-float(sets[0].value[3, 0].sum()), abs=1e-3)
    middle = sets[0].x[3].float()
    ends = game.positions(middle)[[0, -1]]
    torch.testing.assert_close(torch.tensor(episode["label_positions"])[[0, -1]], ends, atol=1e-3, rtol=0)


def two_branches(points: Points) -> PotentialField:
    """Branch 1 is the best one while more than half of the horizon is left."""
    early = points.tau - Walkers.horizon / 2
    one, value = early.unsqueeze(-1), torch.zeros_like(points.theta)
    return PotentialField(one, one, points.x.unsqueeze(-3), value, torch.stack([-early, early], -1))


def test_the_branch_that_is_played_is_kept_at_every_time(sets: list[Extremal]) -> None:
    for episode in kept_of(Walkers(), straight, sets, field=two_branches)["episodes"]:
        assert episode["branch"] == [int(t < Walkers.horizon / 2) for t in episode["t"]]
    assert all(episode["branch"] is None for episode in kept_of(Walkers(), straight, sets)["episodes"])


@pytest.mark.parametrize(
    ("height", "way", "other_side"),
    [(0.2, 0.2, False), (0.2, -0.2, True), (-0.2, 0.2, True), (0.2, 0.5, False), (0.2, -30.0, False)],
)
def test_players_who_pass_on_another_side_than_the_equilibrium_are_marked(
    height: float, way: float, other_side: bool
) -> None:
    """From 30 m aside they hardly turn around each other, and there is no side."""
    label = labelled([height], [0.5], 1.0)
    walked = torch.linspace(0, 4, len(label.t), dtype=torch.float64)
    x = torch.stack([walked, torch.full_like(walked, way)], -1)[None, :, None].repeat(1, 1, 2, 1)
    x[:, 0] = label.x[:, 0]
    x[:, 0, :, 1] = way
    label, start = label._replace(x=x), label
    kept = kept_of(Walkers(), straight, [start], lambda found, paths: zip([label], paths, strict=True))
    assert [one["other_side"] for one in kept["episodes"]] == [other_side] * 2


def test_a_broken_episode_is_the_worst(sets: list[Extremal]) -> None:
    """What is not finite counts as a collision, and stays readable JSON once the writer has replaced it."""

    def broken(found: Sequence[Extremal], paths: Sequence[Trajectory]) -> Any:
        paths[0].clearance[1], paths[0].value[1] = torch.nan, torch.nan
        return zip(found, paths, strict=True)

    worst = kept_of(Walkers(), straight, sets, broken)["episodes"][0]
    assert (worst["kind"], worst["collided"]) == ("worst", True)
    assert worst["distance"] == pytest.approx(1.8, abs=2e-3)


def test_three_dimensions_and_the_size_of_the_file() -> None:
    """Fifty episodes of a grid of types stay small enough to be embedded in a page."""
    game = make("drone")
    found = [fake_labels(game, (1.0, float(t)), 2, t, None, [0.5, 0.5]) for t in range(1, 4)]

    def hover(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return torch.tensor([0.0, 0.0, 9.81]).expand(len(x), 2, 3)

    kept = kept_of(game, hover, found)
    assert kept["dimensions"] == 3
    assert len(json.dumps(kept)) / len(kept["episodes"]) < 8000


def test_one_player_alone_has_episodes_without_a_radius() -> None:
    a, b, r, q, s = (torch.full((1, 1, 1), c) for c in (0.4, 1.3, 0.7, 0.1, 0.9))
    game = LinearQuadratic(a, b, r[..., 0], q, s)
    found = [fake_labels(game, (0.5,), 3)]

    def still(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return torch.zeros(len(x), 1, 1)

    def safe(found: Sequence[Extremal], paths: Sequence[Trajectory]) -> Any:
        return zip(found, (one._replace(clearance=torch.ones(3)) for one in paths), strict=True)

    kept = kept_of(game, still, found, safe, dt=0.1)
    assert [episode["kind"] for episode in kept["episodes"]] == ["worst", "typical"]
    assert kept["players"] == 1
    assert all(episode["radius"] is None for episode in kept["episodes"])
    assert outcome(numbers_of(game, *next(play(game, still, found, 0.1))), 0.02).distance_quantiles is None


def test_where_the_constraint_is_no_distance_there_is_no_radius(sets: list[Extremal]) -> None:
    game = Walkers()
    game.constraint_unit, game.distance_constraints = "", False
    kept = kept_of(game, straight, sets)
    assert kept["constraint_unit"] == ""
    assert all(episode["radius"] is None for episode in kept["episodes"])


def test_beliefs_along_an_episode_are_those_that_were_played_with(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are found again from the path; without learning there are none."""

    def revealing(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return torch.stack([4 + 0.1 * theta, 0.05 * theta.flip(-1)], -1)

    labels = [labelled([0.9, 0.8], [0.5, 0.5], 3.0)]
    past, observe = list[Tensor](), Believing.observe

    def watched(self: Believing, x: Tensor, u: Tensor, dt: float) -> None:
        observe(self, x, u, dt)
        past.append(self.belief)

    policy = Controller(Walkers(), revealing)
    with monkeypatch.context() as patch:
        patch.setattr(Believing, "observe", watched)
        evaluation = evaluation_of(Walkers(), policy, labels, learns="mean", noise=0.1)
        played = next(play(Walkers(), policy, labels, 0.02, evaluation.condition.disturbance))[1]
    first = episodes(evaluation, labels[0], played)[0]
    kept, row = first.content, first.row
    grid = Believing(revealing, game=Walkers()).grid[0].double()
    means = torch.tensor(kept["belief"])[..., 0]
    assert means[0].tolist() == [2.0, 2.0]
    torch.testing.assert_close(means[-1].double(), (past[-1][row] * grid).sum(-1).flip(-1), atol=1e-3, rtol=0)
    low, high = torch.tensor(kept["belief"])[..., 1], torch.tensor(kept["belief"])[..., 2]
    assert ((low <= means + 1e-3) & (means <= high + 1e-3)).all()
    assert (high - low)[-1].max() < (high - low)[0].min(), "something was learned"
    assert kept_of(Walkers(), revealing, labels)["episodes"][0]["belief"] is None
