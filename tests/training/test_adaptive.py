"""Labels that are added while an operator trains."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.control import Feedback
from hno.data import Collocation, GameData, LabelPlan, make_sampler, many
from hno.games import Game, make
from hno.losses import make_objective
from hno.operators import ValueOperator
from hno.pontryagin.solve import Solver
from hno.training import adaptive as module
from hno.training import fit
from hno.training.adaptive import Adaptive, AdaptiveLabels, candidates, judged
from hno.training.fit import LAST
from hno.types import Extremal, PotentialLabels, Trajectory
from tests.fakes import fake_labels, fake_solve
from tests.operators.conftest import small_operator
from tests.operators.test_potential import potential_operator
from tests.training.test_fit import EVERY, STEPS, TYPES, PowerCut, PowerCutError, equal, settings

PLAN = Adaptive(rounds=2, labels=6, candidates=32, types=3, begin=0.25, end=0.6)


class Solved:
    """A solver that answers at once, and what it was asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[float, Tensor, Tensor]] = []

    def __call__(
        self, game: Game, x0: Tensor, theta: Tensor, settings: Solver = Solver(), *, all_equilibria: bool = False
    ) -> Extremal:
        self.asked.append((game.horizon, x0, theta))
        return fake_solve(game, x0, theta, settings, all_equilibria=all_equilibria)


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> Solved:
    solver = Solved()
    monkeypatch.setattr(many, "solve", solver)
    return solver


def data(potential: bool) -> GameData:
    game = make("narrow_road")
    plan = LabelPlan(types=TYPES, trajectories=3, validation=1, cache=Path("unused"), workers=1)
    found = GameData(game, {"bvp"}, 0, plan, batch_sizes={"bvp": 16}, potential=potential)
    found.extremals = [fake_labels(game, theta, seed=row) for row, theta in enumerate(TYPES)]
    return found


def operator(potential: bool) -> ValueOperator:
    made = potential_operator("narrow_road").float() if potential else small_operator(exact_terminal=True)
    return made.requires_grad_()


def trained(folder: Path, potential: bool, **options: Any) -> tuple[ValueOperator, GameData, Any]:
    resume, callbacks = options.pop("resume", None), options.pop("callbacks", [])
    made, labelled = operator(potential), data(potential)
    objective = make_objective({"value": {}, "costate": {}}, {"value": 1.0, "costate": 1.0})
    how = settings(adaptive=PLAN, **options)
    found = fit(made, objective, labelled, how, folder, resume=resume, callbacks=callbacks)
    return made, labelled, found


def test_rounds_are_spread_between_begin_and_end() -> None:
    assert Adaptive(rounds=3, begin=0.4, end=0.8).steps(100) == [40, 60, 80]
    assert Adaptive(rounds=1, begin=0.4).steps(100) == [40]
    assert Adaptive().steps(100) == []


@pytest.mark.parametrize(("rounds", "total"), [(2, 1), (9, 4), (1, 1)])
def test_rounds_that_do_not_fit_are_refused(rounds: int, total: int) -> None:
    with pytest.raises(ValueError, match=rf"{rounds} rounds of added labels do not fit into {total} steps"):
        Adaptive(rounds=rounds).steps(total)


def test_a_training_without_labels_adds_none(tmp_path: Path, solved: Solved) -> None:
    made = operator(True)
    plan, sampler = LabelPlan(types=TYPES, cache=Path("unused")), make_sampler({"box": 1.0})
    physics = GameData(made.game, {"interior"}, 0, plan, Collocation(sampler), {"interior": 16}, potential=True)
    found = fit(made, make_objective({"residual": {}}, {"residual": 1.0}), physics, settings(adaptive=PLAN), tmp_path)
    assert found.rounds == []
    assert solved.asked == []
    assert found.trainer.global_step == STEPS


def test_a_round_labels_no_more_states_than_it_has(solved: Solved) -> None:
    labelled = data(True)
    labelled.setup("fit")
    policy, plan = (
        Feedback(potential_operator("narrow_road").float(), checked=False),
        replace(PLAN, labels=400, candidates=400),
    )
    found = AdaptiveLabels(plan, STEPS, 0, 0.1, workers=1).round(policy, labelled, 2)
    assert found.labelled == found.candidates < plan.candidates  # some of these are in the violation set


def test_labels_that_collide_are_counted_and_not_trained_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def colliding(game: Game, x0: Tensor, theta: Tensor, *arguments: Any, **options: Any) -> Extremal:
        return fake_solve(game, x0, theta, **options)._replace(clearance=torch.full((len(x0),), -0.1).double())

    monkeypatch.setattr(many, "solve", colliding)
    labelled = data(True)
    labelled.setup("fit")
    policy = Feedback(potential_operator("narrow_road").float(), checked=False)
    found = AdaptiveLabels(PLAN, STEPS, 0, 0.1, workers=1).round(policy, labelled, 2)
    assert (found.inevitable, found.lost, labelled.labelled.added) == (PLAN.labels, None, [])


@pytest.mark.parametrize("potential", [False, True])
def test_what_a_round_labels_is_trained_on(tmp_path: Path, solved: Solved, potential: bool) -> None:
    _, labelled, found = trained(tmp_path, potential)
    assert [entry.step for entry in found.rounds] == PLAN.steps(STEPS)
    assert all(entry.labelled == PLAN.labels for entry in found.rounds)
    assert found.seconds["added_labels"] > 0
    before, _ = labelled.labelled.at(0)
    after, drawn = labelled.labelled.at(STEPS)
    assert before.size == labelled.train_rows.size < after.size
    assert set(drawn.tolist()) == set(range(after.size))
    own = sum(len(x0) * (1 + round(tau / 0.1)) for tau, x0, _ in solved.asked)
    assert after.size - before.size == own * (2 if potential else 1)  # both orders of equal players
    if potential:
        assert isinstance(after.labels, PotentialLabels)
        assert after.types.branch.shape == (after.size,)


def test_time_to_go_ends_with_the_game(tmp_path: Path, solved: Solved) -> None:
    _, labelled, _ = trained(tmp_path, True)
    assert len({tau for tau, *_ in solved.asked}) > 1
    points = [torch.cat(column) for column in zip(*(rows.points for _, rows in labelled.labelled.added), strict=True)]
    for horizon, starts, _ in solved.asked:
        for x0 in starts.float():
            first = (points[1] == x0).flatten(1).all(-1)
            assert points[0][first].tolist() == pytest.approx([horizon] * int(first.sum()))
            assert bool(first.any())
    assert float(points[0].min()) == 0


def test_a_batch_that_is_drawn_already_does_not_change() -> None:
    labelled = data(True)
    labelled.setup("fit")
    before = [labelled.batch(step)["bvp"] for step in range(4)]
    labelled.labelled.extend(2, [fake_labels(make("narrow_road"), (2.0, 3.0), count=5, seed=9)])
    after = [labelled.batch(step)["bvp"] for step in range(4)]
    for one, other in list(zip(before, after, strict=True))[:3]:
        assert torch.equal(one.points.x, other.points.x)
    assert not torch.equal(before[3].points.x, after[3].points.x)


@pytest.mark.parametrize("potential", [False, True])
def test_a_resumed_run_with_rounds_is_the_uninterrupted_one(tmp_path: Path, solved: Solved, potential: bool) -> None:
    whole, _, found = trained(tmp_path / "whole", potential)
    with pytest.raises(PowerCutError):
        trained(tmp_path / "cut", potential, callbacks=[PowerCut()])
    resumed, labelled, again = trained(tmp_path / "cut", potential, resume=tmp_path / "cut" / LAST)
    assert equal(whole, resumed)
    assert [entry[:-1] for entry in found.rounds] == [entry[:-1] for entry in again.rounds]
    assert len(labelled.labelled.added) == 2
    assert PLAN.steps(STEPS)[0] < EVERY < PLAN.steps(STEPS)[1]  # one before the cut, one after


def test_candidates_are_safe_states_with_the_rest_of_the_game_to_go() -> None:
    game, policy = make("narrow_road"), Feedback(potential_operator("narrow_road").float(), checked=False)
    groups = list(candidates(game, policy, Adaptive(candidates=400), 0.1, torch.Generator().manual_seed(0)))
    assert [group.tau for group in groups] == pytest.approx([3.0, 2.2, 1.5, 0.8], abs=0.1)
    for group in groups:
        assert not bool(game.violates(group.x, group.theta).any())
        assert bool(game.type_box.contains(group.theta).all())
    assert bool(game.state_box.contains(groups[0].x).all())
    spread = groups[0].x.flatten(0, 1).amax(0) - groups[0].x.flatten(0, 1).amin(0)
    assert bool((spread > 0.9 * game.state_box.width[0]).all())  # anywhere in the PDE box
    assert len(groups[0].theta.unique(dim=0)) <= 16


def test_an_episode_is_left_when_its_time_to_go_is_that_of_the_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes in which a speed says how many controls were held so far."""

    def counting(game: Game, policy: Any, x0: Tensor, theta: Tensor, dt: float, **options: Any) -> Trajectory:
        steps = round(game.horizon / dt)
        x = x0.unsqueeze(1).repeat(1, steps + 1, 1, 1)
        x[..., 3] = torch.arange(steps + 1).float().view(1, -1, 1)
        empty = torch.empty(0)
        return Trajectory(dt * torch.arange(steps + 1), x, empty, empty, empty, empty)

    monkeypatch.setattr(module, "rollout", counting)
    game, policy = make("narrow_road"), Feedback(potential_operator("narrow_road").float(), checked=False)
    _, *left = candidates(game, policy, Adaptive(candidates=64), 0.1, torch.Generator().manual_seed(0))
    for group in left:
        assert group.x[..., 3].unique().tolist() == [round((game.horizon - group.tau) / 0.1)]


def test_the_states_that_are_labelled_are_those_that_disappoint_most(solved: Solved) -> None:
    labelled = data(True)
    labelled.setup("fit")
    policy = Feedback(potential_operator("narrow_road").float(), checked=False)
    callback = AdaptiveLabels(PLAN, STEPS, 0, 0.1, workers=1)
    seen = list[tuple[Tensor, Tensor]]()

    def watched(policy: Feedback, group: module.Candidates, dt: float) -> tuple[Tensor, Tensor, Tensor]:
        found = judged(policy, group, dt)
        seen.append((found[0], group.x))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "judged", watched)
        found = callback.round(policy, labelled, 2)
    gaps, states = (torch.cat(column) for column in zip(*seen, strict=True))
    chosen = torch.cat([x0 for _, x0, _ in solved.asked]).float()
    least = min(float(gap) for gap, x in zip(gaps, states, strict=True) if (chosen == x).flatten(1).all(-1).any())
    assert len(chosen) == PLAN.labels
    assert least >= float(gaps.topk(PLAN.labels).values[-1])
    assert found.candidates == len(gaps)


def test_a_policy_that_keeps_its_promise_has_no_gap() -> None:
    """A controller that never moves, in a game that ends at once, promises what it gets."""
    game = make("narrow_road")
    policy = Feedback(potential_operator("narrow_road").float(), checked=False)
    x = game.initial_box.sample(16, torch.Generator().manual_seed(0))
    theta = game.type_box.lo.expand(16, -1)
    gap, cost, collided = judged(policy, module.Candidates(0.02, x, theta), 0.02)
    assert float(gap.max()) < 0.1
    assert not bool(collided.any())
    assert math.isfinite(float(cost.sum()))
