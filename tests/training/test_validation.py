"""Closed-loop validation while a model trains, on policies whose episodes are known."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.control import Feedback
from hno.control.rollout import rollout
from hno.data import Collocation, GameData, LabelPlan, make_sampler
from hno.games import Game, make
from hno.training import validation
from hno.training.module import TrainingModule
from hno.training.validation import BEST, ClosedLoopValidation, Later, Score, score, starts_of
from hno.types import Extremal, Field, Points, Trajectory, join
from tests.fakes import fake_labels, played_table
from tests.operators.conftest import MakeModule
from tests.walkers import Walkers

GAMES = ("narrow_road", "lane_change", "drone")
SAFE, CLOSE = 0.9, 0.05
"""Heights of starts: straight walkers of one height pass each other by twice that; their radii add up to 0.4 m."""


class Trainer:
    """As much of a trainer as a validation needs; a checkpoint holds the step."""

    def __init__(self, max_steps: int = 100, datamodule: object = None) -> None:
        self.global_step, self.max_steps, self.should_stop = 0, max_steps, False
        self.datamodule = datamodule

    def save_checkpoint(self, path: Path, weights_only: bool) -> None:
        assert not weights_only, "a checkpoint to resume from holds the optimiser too"
        Path(path).write_text(str(self.global_step))


def straight(x: Tensor) -> Tensor:
    """4 m/s along x."""
    return torch.tensor([4.0, 0.0]).to(x).expand_as(x)


def away(x: Tensor) -> Tensor:
    """Backwards: nobody meets, and nobody arrives."""
    return -straight(x)


def nowhere(x: Tensor) -> Tensor:
    return torch.full_like(x, torch.nan)


Play = Callable[[Tensor], Tensor]


@pytest.fixture
def walking(monkeypatch: pytest.MonkeyPatch, make_module: MakeModule) -> Callable[[Play], TrainingModule]:
    """Training of an operator of the walkers' game whose policy is known: the costate of a velocity u is 2 u."""

    def build(play: Play) -> TrainingModule:
        module = make_module(Walkers(), width=8, depth=1)

        def field(points: Points, types: object = None) -> Field:
            costate = torch.zeros(len(points.x), 2, 2, 2)
            for i in range(2):
                costate[:, i, i] = 2 * play(points.x)[:, i]
            return Field(points.theta, points.theta, costate)

        monkeypatch.setattr(module.operator, "field", field)
        return module

    return build


def labelled(heights: Sequence[float], theta: float = 1.0, excess: float | None = None) -> Extremal:
    """Labels from starts of these heights.

    Args:
        heights: of each start.
        theta: of both players.
        excess: choose values so that straight walkers cost so much more, relative to the label.
    """
    start = torch.tensor([[[0.0, y], [0.0, y]] for y in heights])
    found = fake_labels(Walkers(), (theta, theta), len(heights), start=start)
    if excess is None:
        return found
    played = rollout(Walkers(), lambda tau, x, types: straight(x), start, found.theta.float())
    value = found.value.clone()
    value[:, 0] = played.value / (1 + excess)
    return found._replace(value=value)


@pytest.fixture
def make_validation(tmp_path: Path) -> Callable[..., ClosedLoopValidation]:
    """A validation every 10 steps."""

    def build(**options: Any) -> ClosedLoopValidation:
        return ClosedLoopValidation(**({"folder": tmp_path, "every": 10} | options))

    return build


Build = Callable[..., ClosedLoopValidation]
Walking = Callable[[Play], TrainingModule]


@pytest.mark.parametrize(("safe", "close"), [(4, 0), (3, 1), (1, 3), (0, 4)])
def test_score_is_the_share_of_collisions(make_validation: Build, walking: Walking, safe: int, close: int) -> None:
    callback = make_validation()
    callback.begin([labelled([SAFE] * safe + [CLOSE] * close)])
    found = callback.consider(Trainer(), walking(straight))
    assert found is not None
    assert found.collision_rate == close / 4


@pytest.mark.parametrize("excess", [0.0, 0.25, -0.2, 3.0])
def test_excess_is_relative_to_the_cost_of_the_equilibria(
    make_validation: Build, walking: Walking, excess: float
) -> None:
    callback = make_validation()
    callback.begin([labelled([0.5, 0.6, 0.9], excess=excess), labelled([0.7, 0.8], theta=2.0, excess=excess)])
    found = callback.consider(Trainer(), walking(straight))
    assert found is not None
    assert found.excess == pytest.approx(excess, abs=1e-4)


def test_score_looks_at_the_types_of_each_start(make_validation: Build, walking: Walking) -> None:
    """Walkers who miss each other by 0.6 m; the radius is 0.2 + 0.2 theta."""
    callback = make_validation()
    callback.begin([labelled([0.3], theta=theta) for theta in (1.0, 4.0, 1.5, 3.0)])
    found = callback.consider(Trainer(), walking(straight))
    assert found is not None
    assert found.collision_rate == 0.5


def test_safety_comes_first_then_cost() -> None:
    order = [Score(0.0, -0.1), Score(0.0, 0.2), Score(0.0, math.inf), Score(0.1, -5.0), Score(1.0, -9.0)]
    for place, found in enumerate(order):
        assert [found.after(other) is not None for other in order] == [place <= k for k in range(len(order))]


def test_one_broken_episode_collides_and_does_not_spoil_the_median() -> None:
    starts = starts_of([labelled([SAFE] * 5, excess=0.5)])
    played = rollout(Walkers(), lambda tau, x, theta: straight(x), starts.x0, starts.theta)
    value, clearance = played.value.clone(), played.clearance.clone()
    value[2], clearance[2] = torch.nan, torch.nan
    found = score(played._replace(value=value, clearance=clearance), starts)
    assert found.collision_rate == pytest.approx(0.2)
    assert found.excess == pytest.approx(0.5, abs=1e-3)
    touching = clearance.nan_to_num(1.0)
    touching[4] = 0.0
    assert score(played._replace(clearance=touching), starts).collision_rate == pytest.approx(0.2)


def test_a_policy_that_is_not_a_number_collides(make_validation: Build, walking: Walking) -> None:
    callback, trainer = make_validation(), Trainer()
    callback.begin([labelled([SAFE] * 3)])
    found = callback.consider(trainer, walking(nowhere))
    assert found is not None
    assert found.collision_rate == 1
    assert found.excess > 1e6
    better = callback.consider(trainer, walking(away))
    assert better is not None
    assert callback.best == better < found


@pytest.mark.parametrize("name", GAMES)
@pytest.mark.parametrize("value", [torch.nan, torch.inf, 1e30])
def test_weights_that_diverged_collide_without_an_error(
    make_validation: Build, make_module: MakeModule, name: str, value: float
) -> None:
    game, module = make(name), make_module(name, width=8, depth=1)
    with torch.no_grad():
        for weights in module.operator.parameters():
            weights.fill_(value)
    callback = make_validation(dt=0.1)
    callback.begin([fake_labels(game, (1.0, 5.0), 3)])
    found = callback.consider(Trainer(), module)
    assert found is not None
    assert 0 <= found.collision_rate <= 1
    if not math.isfinite(value):
        assert found.collision_rate == 1


@pytest.mark.parametrize("name", GAMES)
@pytest.mark.parametrize("exact", [False, True])
def test_episodes_are_those_of_the_evaluation(
    make_validation: Build, make_module: MakeModule, name: str, exact: bool
) -> None:
    """The same policy, starts and collisions as in the table of an evaluated checkpoint."""
    game, module = make(name), make_module(name, width=8, depth=1, exact_terminal=exact)
    start = game.initial_box.sample(12, torch.Generator().manual_seed(0))
    labels = [fake_labels(game, (1.0, 5.0), 12, start=start), fake_labels(game, (2.0, 2.0), 12, seed=1, start=start)]
    callback = make_validation(dt=0.1, probe=12)
    callback.begin(labels)
    found = callback.consider(Trainer(), module)
    rows = played_table(game, Feedback(module.operator.eval().requires_grad_(False)), labels, [], dt=0.1)
    assert found is not None
    assert found.collision_rate == pytest.approx(sum(row.outcome.collisions for row in rows) / 24)
    single = [row.outcome.median_excess_cost for row in rows]
    assert min(single) <= found.excess * float(starts_of(labels).cost.median()) <= max(single)


@pytest.fixture
def episodes(monkeypatch: pytest.MonkeyPatch) -> list[Tensor]:
    """Start states of every simulation that a validation asks for."""
    seen: list[Tensor] = []
    original = validation.rollout

    def watched(game: Game, policy: object, x0: Tensor, *arguments: object) -> Trajectory:
        seen.append(x0)
        return original(game, policy, x0, *arguments)

    monkeypatch.setattr(validation, "rollout", watched)
    return seen


@pytest.mark.parametrize(
    ("probe", "first", "second", "played", "rate"),
    [
        (2, [SAFE, SAFE, SAFE, CLOSE, SAFE], [SAFE, SAFE, CLOSE], [4, 8], 2 / 8),
        (2, [SAFE] * 4, [SAFE, CLOSE, SAFE, SAFE], [4, 8], 1 / 8),
        (2, [SAFE] * 11, [SAFE, CLOSE, *[SAFE] * 7], [4], (1 + 16) / 20),
        (3, [SAFE] * 3, [SAFE] * 2, [5], 0),
    ],
    ids=["the first ones are safe", "there are few", "a first one collides among many", "the first ones are all"],
)
def test_first_starts_are_played_first_and_all_unless_they_collide(
    make_validation: Build,
    walking: Walking,
    episodes: list[Tensor],
    probe: int,
    first: list[float],
    second: list[float],
    played: list[int],
    rate: float,
) -> None:
    """What was not played counts as colliding, so that nobody profits from being stopped early."""
    callback = make_validation(probe=probe)
    callback.begin([labelled(first), labelled(second, theta=2.0)])
    found = callback.consider(Trainer(), walking(straight))
    assert [len(x0) for x0 in episodes] == played
    assert episodes[0][:, 0, 1].tolist() == pytest.approx([*first[:probe], *second[:probe]])
    assert found is not None
    assert found.collision_rate == pytest.approx(rate)


@pytest.mark.parametrize(("first", "solved"), [(CLOSE, 0), (SAFE, 1)])
def test_later_starts_are_solved_once_and_only_when_none_of_the_first_collides(
    make_validation: Build, walking: Walking, first: float, solved: int
) -> None:
    callback, module, asked = make_validation(), walking(straight), list[int]()

    def solve() -> list[Extremal]:
        asked.append(1)
        return [labelled([first] * 2 + [CLOSE] * 6)]

    callback.begin([labelled([first] * 2)], Later(20, solve))
    found = [callback.consider(Trainer(), module) for _ in range(2)]
    assert len(asked) == solved
    rate = 6 / 8 if solved else 1.0
    assert [score.collision_rate for score in found if score is not None] == [rate, rate]


def test_a_validation_without_starts_rests(make_validation: Build, walking: Walking, tmp_path: Path) -> None:
    for callback in (make_validation(), make_validation()):
        trainer = Trainer()
        assert callback.consider(trainer, walking(straight)) is None
        trainer.global_step = 10
        callback.on_train_batch_end(trainer, walking(straight), None, None, 0)
        callback.begin([])
    assert list(tmp_path.iterdir()) == []
    assert callback.state_dict() == {"best": None, "seconds": 0.0, "solving": 0.0}


def test_it_plays_every_so_often_and_at_the_end(
    make_validation: Build, walking: Walking, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[int] = []

    def play(self: ClosedLoopValidation, trainer: Trainer, *others: object) -> Score:
        steps.append(trainer.global_step)
        return Score(1.0, 0.0)

    monkeypatch.setattr(ClosedLoopValidation, "play", play)
    callback, module, trainer = make_validation(every=4), walking(straight), Trainer(max_steps=10)
    callback.begin([labelled([SAFE])])
    for trainer.global_step in range(1, 11):
        callback.on_train_batch_end(trainer, module, None, None, trainer.global_step - 1)
    assert steps == [4, 8, 10]
    even = Trainer(max_steps=8)
    for even.global_step in range(1, 9):
        callback.on_train_batch_end(even, module, None, None, even.global_step - 1)
    assert steps == [4, 8, 10, 4, 8]


def test_best_checkpoint_is_that_of_the_best_score(
    make_validation: Build, walking: Walking, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Of equal scores, the last."""
    scores = [
        Score(1.0, math.inf), Score(1.0, math.inf), Score(0.5, 0.1), Score(0.5, 0.2), Score(0.6, -9.0), Score(0.2, 9.0),
        Score(0.2, 9.0), Score(0.0, math.inf), Score(0.01, -1.0), Score(0.0, 3.0), Score(0.0, math.nan),
        Score(math.nan, 0.0), Score(0.0, 2.9),
    ]  # fmt: skip
    kept = [1, 2, 3, 3, 3, 6, 7, 8, 8, 10, 10, 10, 13]
    monkeypatch.setattr(ClosedLoopValidation, "play", lambda self, trainer, *_: scores[trainer.global_step - 1])
    callback, module, trainer = make_validation(every=1), walking(straight), Trainer()
    callback.begin([labelled([SAFE])])
    for number, step in enumerate(kept):
        trainer.global_step = number + 1
        callback.on_train_batch_end(trainer, module, None, None, number)
        assert (tmp_path / BEST).read_text() == str(step)
        assert callback.best == scores[step - 1]


def kept_scores(callback: ClosedLoopValidation, module: TrainingModule, found: Sequence[Score]) -> list[Score | None]:
    """The best score after each of these."""
    callback.begin([labelled([SAFE])])
    scores, kept = iter(found), list[Score | None]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ClosedLoopValidation, "play", lambda self, *_: next(scores))
        for _ in found:
            callback.consider(Trainer(), module)
            kept.append(callback.best)
    return kept


def test_of_costs_that_differ_by_chance_the_later_is_kept(make_validation: Build, walking: Walking) -> None:
    """Within a per cent of the equilibria's cost, and among equal shares of collisions only."""
    scores = [
        Score(0.1, 0.2),
        Score(0.1, 0.209),
        Score(0.1, 0.25),
        Score(0.2, 0.209),
        Score(0.05, 9.0),
        Score(0.05, 9.009),
    ]
    kept = kept_scores(make_validation(), walking(straight), scores)
    assert kept == [scores[k] for k in (0, 0, 0, 0, 4, 4)]
    assert scores[1].after(scores[0]) == scores[0]
    assert scores[2].after(scores[0]) is None


def test_costs_do_not_creep_up_by_chance(make_validation: Build, walking: Walking) -> None:
    kept = kept_scores(make_validation(), walking(straight), [Score(0.0, 0.1 + 0.009 * k) for k in range(30)])
    assert all(best is not None and best.excess <= 0.1 + 0.02 for best in kept)


def test_a_policy_that_collides_wherever_another_one_does_and_more_is_not_better(
    make_validation: Build, walking: Walking
) -> None:
    """The first one is safe from the first starts, so that all are played: 3 of 5 collide. The second one collides
    from one of two first starts, and would from 4 of 5."""

    high: list[Tensor] = []

    def worse(x: Tensor) -> Tensor:
        """Whoever starts highest walks down, into the other one's way."""
        if not x[..., 0].any():
            high.append(x[:, :1, 1:] > 0.87)
        return torch.where(high[-1], torch.tensor([4.0, -1.8]), straight(x))

    callback, trainer = make_validation(probe=2), Trainer()
    callback.begin([labelled([SAFE, 0.8, CLOSE, CLOSE, CLOSE])])
    first = callback.consider(trainer, walking(straight))
    assert first is not None
    assert first.collision_rate == pytest.approx(3 / 5)
    callback.consider(trainer, walking(worse))
    assert callback.best == first


@pytest.mark.parametrize("stop", [False, True])
def test_training_ends_once_it_is_safe_if_asked(make_validation: Build, walking: Walking, stop: bool) -> None:
    callback, trainer = make_validation(stop=stop, every=1, probe=1), Trainer()
    callback.begin([labelled([SAFE, CLOSE])])
    trainer.global_step = 1
    callback.on_train_batch_end(trainer, walking(straight), None, None, 0)
    assert not trainer.should_stop, "the first ones are safe, but not all"
    callback.on_train_batch_end(trainer, walking(nowhere), None, None, 1)
    assert not trainer.should_stop
    callback.on_train_batch_end(trainer, walking(away), None, None, 2)
    assert trainer.should_stop == stop


def test_what_was_found_is_logged(make_validation: Build, walking: Walking, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[dict[str, float]] = []
    module, trainer, callback = walking(straight), Trainer(), make_validation(every=1)
    monkeypatch.setattr(TrainingModule, "log_dict", lambda self, values, **kwargs: told.append(values))
    callback.begin([labelled([SAFE, CLOSE], excess=0.5)])
    callback.on_train_batch_end(trainer, module, None, None, 0)
    callback.on_validation_epoch_end(trainer, module)
    assert told == [{"closed_loop/collision_rate": 0.5, "closed_loop/excess": pytest.approx(0.5, abs=1e-3)}]
    assert 0 < callback.seconds < 60


def test_data_are_told_where_the_first_starts_led(make_validation: Build, walking: Walking, tmp_path: Path) -> None:
    sampler, sizes = make_sampler({"rollout": 1.0}), {"bvp": 4, "interior": 4, "terminal": 4}
    labels = LabelPlan(types=[(1.0, 1.0)], trajectories=2, cache=tmp_path)
    data = GameData(Walkers(), {"interior"}, 0, labels, Collocation(sampler), sizes)
    callback = make_validation(probe=2, dt=0.1)
    callback.begin([labelled([SAFE, 0.7, 0.5])])
    callback.consider(Trainer(datamodule=data), walking(straight))
    assert data.visits
    _, times, states = data.visits[-1]
    assert times.shape == (2 * 11,)
    torch.testing.assert_close(states[..., 0], 4 * (1 - times).unsqueeze(-1).expand(-1, 2))
    assert set(states[..., 1].flatten().tolist()) == {torch.tensor(SAFE).item(), torch.tensor(0.7).item()}
    callback.consider(Trainer(datamodule=data), walking(away))
    torch.testing.assert_close(data.visits[-1].x[..., 0], -4 * (1 - times).unsqueeze(-1).expand(-1, 2))
    assert callback.consider(Trainer(datamodule=object()), walking(away)) is not None


def test_the_best_score_survives_a_checkpoint(make_validation: Build, walking: Walking, tmp_path: Path) -> None:
    first = make_validation()
    first.begin([labelled([SAFE, CLOSE])])
    first.consider(Trainer(), walking(away))
    resumed = make_validation()
    resumed.load_state_dict(first.state_dict())
    assert resumed.best == first.best
    assert isinstance(resumed.best, Score)
    resumed.begin([labelled([SAFE, CLOSE])])
    trainer = Trainer()
    trainer.global_step = 77
    resumed.consider(trainer, walking(straight))
    assert (tmp_path / BEST).read_text() == "0", "worse than before the interruption"


def test_a_best_score_without_its_checkpoint_is_forgotten(
    make_validation: Build, walking: Walking, tmp_path: Path
) -> None:
    first = make_validation()
    first.begin([labelled([SAFE, CLOSE])])
    first.consider(Trainer(), walking(away))
    (tmp_path / BEST).unlink()
    resumed = make_validation()
    resumed.load_state_dict(first.state_dict())
    assert resumed.best is None
    resumed.begin([labelled([SAFE, CLOSE])])
    resumed.consider(Trainer(), walking(straight))
    assert (tmp_path / BEST).exists()


def test_a_state_without_a_score_is_one_too(make_validation: Build) -> None:
    callback = make_validation()
    callback.load_state_dict(make_validation().state_dict())
    assert callback.best is None


def test_starts_keep_the_order_of_their_labels() -> None:
    labels = [labelled([SAFE, CLOSE]), labelled([0.5], theta=2.0)]
    starts = starts_of(labels)
    whole = join(labels)
    assert torch.equal(starts.x0, whole.x[:, 0].float())
    assert torch.equal(starts.theta, whole.theta.float())
    torch.testing.assert_close(starts.cost, -whole.value[:, 0].sum(-1).float())


def test_an_operator_in_double_precision_is_validated(make_validation: Build, make_module: MakeModule) -> None:
    game, module = make("narrow_road"), make_module(width=8, depth=1).double()
    callback = make_validation(dt=0.1)
    callback.begin([fake_labels(game, (1.0, 5.0), 3)])
    assert callback.consider(Trainer(), module) is not None


def test_starts_go_to_the_device_of_the_operator(
    make_validation: Build, make_module: MakeModule, monkeypatch: pytest.MonkeyPatch
) -> None:
    devices: list[str] = []

    class SeenError(Exception):
        pass

    def look(game: Game, policy: object, x0: Tensor, theta: Tensor, *others: object) -> Trajectory:
        devices.extend((x0.device.type, theta.device.type))
        raise SeenError

    monkeypatch.setattr(validation, "rollout", look)
    module = make_module(width=8, depth=1).to("meta")
    callback = make_validation()
    callback.begin([fake_labels(make("narrow_road"), (1.0, 5.0), 3)])
    with pytest.raises(SeenError):
        callback.consider(Trainer(), module)
    assert devices == ["meta", "meta"]
