"""The learned policy as a pure function of one state, and policies that remember."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from hno.control import Feedback, Policy, as_policy
from hno.control.policy import Answer
from hno.control.receding_horizon import RecedingHorizon
from hno.control.rollout import Disturbance, rollout
from hno.types import Points
from tests.crossing import Crossing
from tests.operators.conftest import GAMES, random_points, small_operator
from tests.walkers import Walkers

TIGHT = {"rtol": 1e-10, "atol": 1e-10}


def asked(members: int, game: str = "lane_change", rows: int = 5) -> tuple[Feedback, Points]:
    """A policy in double precision, and states to ask it about."""
    operator = small_operator(game, exact_terminal=True, members=members).double().requires_grad_(False)
    return Feedback(operator), random_points(operator.game, rows)


def expected(policy: Feedback, points: Points) -> Answer:
    return Answer(policy.value(*points), policy.costate(*points), policy.act(*points))


def close(found: Answer, wanted: Answer) -> None:
    for part, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(part, other, **TIGHT)


@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("members", [1, 3])
def test_the_answer_is_what_the_policy_says_of_a_batch(game: str, members: int) -> None:
    policy, points = asked(members, game)
    wanted = expected(policy, points)
    for row, at in enumerate(zip(*points, strict=True)):
        close(policy.answer(*at), Answer(*(part[row] for part in wanted)))
    close(Answer(*torch.vmap(policy.answer)(*points)), wanted)


@pytest.mark.parametrize("net", [torch.float32, torch.float64])
@pytest.mark.parametrize("asked_in", [torch.float32, torch.float64])
def test_every_answer_is_in_the_type_of_the_question(net: torch.dtype, asked_in: torch.dtype) -> None:
    operator = small_operator("drone", exact_terminal=True).to(net).requires_grad_(False)
    policy, points = Feedback(operator), Points(*(p.to(asked_in) for p in random_points(operator.game, 3)))
    wanted = expected(policy, points)
    mapped, alone = torch.vmap(policy.answer)(*points), policy.answer(*(part[0] for part in points))
    assert {part.dtype for part in (*wanted, *mapped, *alone)} == {asked_in}
    for part, other in zip(mapped, wanted, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-3, atol=1e-3)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("trained", [True, False])
@pytest.mark.parametrize("members", [1, 3])
def test_three_players_are_answered_in_a_batch_without_a_warning(members: int, trained: bool) -> None:
    operator = small_operator(Crossing(), members=members).double().requires_grad_(not trained)
    policy, points = Feedback(operator), random_points(operator.game, 4)
    close(Answer(*torch.vmap(policy.answer)(*points)), expected(policy, points))


@pytest.mark.parametrize("members", [1, 3])
def test_the_answer_can_be_differentiated_in_the_state(members: int) -> None:
    """Central differences of what the policy plays."""
    policy, (tau, x, theta) = asked(members)
    policy.operator.value_scale.fill_(400.0)  # some controls inside their box
    jacobian = torch.vmap(torch.func.jacrev(lambda x, tau, theta: policy.answer(tau, x, theta).control))(x, tau, theta)
    step = 1e-5
    for player in range(2):
        for state in range(4):
            moved = torch.zeros_like(x)
            moved[:, player, state] = step
            slope = (policy(tau, x + moved, theta) - policy(tau, x - moved, theta)) / (2 * step)
            torch.testing.assert_close(jacobian[..., player, state], slope, rtol=1e-4, atol=1e-6)
    assert bool(jacobian.any())


def test_the_costate_is_the_derivative_of_the_value() -> None:
    policy, points = asked(1)
    value = torch.func.jacrev(lambda x, tau, theta: policy.answer(tau, x, theta).value)
    for tau, x, theta in zip(*points, strict=True):
        torch.testing.assert_close(value(x, tau, theta), policy.answer(tau, x, theta).costate, **TIGHT)


@pytest.mark.parametrize("members", [1, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mapped", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_answer_compiles(members: int, mapped: bool) -> None:
    policy, points = asked(members)
    torch.compiler.reset()
    wanted = expected(policy, points)
    if mapped:
        close(Answer(*torch.compile(torch.vmap(policy.answer), backend="eager")(*points)), wanted)
        return
    answer = torch.compile(policy.answer, backend="aot_eager", fullgraph=True)
    for row, at in enumerate(zip(*points, strict=True)):
        close(Answer(*answer(*at)), Answer(*(part[row] for part in wanted)))


def test_a_feedback_refuses_what_it_has_no_answer_to_unless_told_not_to() -> None:
    policy, points = asked(1)
    broken = points._replace(x=points.x * torch.nan)
    for ask in (policy, policy.value, policy.costate):
        with pytest.raises(ValueError, match="finite"):
            ask(*broken)
        with pytest.raises(ValueError, match=r"Expected tau \(B,\), x \(B, 2, 4\)"):
            ask(points.tau, points.x[:, :1], points.theta)
    assert bool(Feedback(policy.operator, checked=False)(*broken).isnan().any())


class Diary(Policy):
    """Writes down what it is told, and brakes by what it has seen so far."""

    def __init__(self) -> None:
        self.pages: list[tuple[str, Any]] = []
        self.seen = 0

    def reset(self, x0: Tensor, theta: Tensor) -> None:
        self.pages.append(("reset", (x0, theta)))
        self.seen = 0

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        self.pages.append(("act", (tau, x, theta)))
        return torch.full_like(x, 4.0 - 0.5 * self.seen)

    def observe(self, x: Tensor, u: Tensor, dt: float) -> None:
        self.pages.append(("observe", (x, u, dt)))
        self.seen += 1


def walkers(count: int = 3) -> tuple[Tensor, Tensor]:
    return Walkers().initial_box.sample(count, torch.Generator().manual_seed(0)), torch.ones(count, 2)


def test_a_policy_with_memory_is_reset_once_and_told_after_every_step() -> None:
    diary, (x0, theta) = Diary(), walkers()
    played = rollout(Walkers(), diary, x0, theta, 0.2)
    assert [name for name, _ in diary.pages] == ["reset", *["act", "observe"] * 5]
    assert torch.equal(diary.pages[0][1][0], x0)
    assert torch.equal(diary.pages[0][1][1], theta)
    for k in range(5):
        (tau, x, types), (reached, u, dt) = diary.pages[1 + 2 * k][1], diary.pages[2 + 2 * k][1]
        assert tau.tolist() == pytest.approx([1 - 0.2 * k] * 3)
        assert torch.equal(x, played.x[:, k])
        assert torch.equal(types, theta)
        assert torch.equal(reached, played.x[:, k + 1])
        assert torch.equal(u, played.u[:, k])
        assert dt == 0.2
    assert played.u[0, :, 0, 0].tolist() == pytest.approx([4.0, 3.5, 3.0, 2.5, 2.0])
    again = rollout(Walkers(), diary, x0, theta, 0.2)
    assert torch.equal(again.x, played.x), "the second episode begins with an empty memory"


@pytest.mark.parametrize("disturbance", [Disturbance(noise=0.3), Disturbance(delay=2)])
def test_a_policy_is_told_the_controls_that_were_applied(disturbance: Disturbance) -> None:
    """Not the ones that it chose."""
    diary, (x0, theta) = Diary(), walkers()
    played = rollout(Walkers(), diary, x0, theta, 0.2, disturbance=disturbance)
    told = [page for name, page in diary.pages if name == "observe"]
    assert torch.equal(torch.stack([u for _, u, _ in told], 1), played.u)
    assert torch.equal(torch.stack([x for x, _, _ in told], 1), played.x[:, 1:])
    chosen = torch.tensor([4.0, 3.5, 3.0, 2.5, 2.0]).view(1, 5, 1, 1).expand_as(played.u)
    assert not torch.allclose(played.u, chosen)


def test_players_with_beliefs_remember_each_for_itself() -> None:
    diary, (x0, theta) = Diary(), walkers()
    rollout(Walkers(), diary, x0, theta, 0.2, disturbance=Disturbance(belief=0.5))
    assert [name for name, _ in diary.pages] == ["reset", *["act", "observe"] * 5]
    assert all(len(page[0]) == 6 for _, page in diary.pages)
    assert torch.equal(diary.pages[0][1][0], x0.repeat_interleave(2, 0))


def test_a_bare_function_is_a_policy_without_memory() -> None:
    def straight(tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        return 0 * x + tau[:, None, None]

    x0, theta = walkers()
    policies: list[Policy | Callable[..., Tensor]] = [straight, as_policy(straight), as_policy(as_policy(straight))]
    played = [rollout(Walkers(), policy, x0, theta, 0.2).x for policy in policies]
    assert torch.equal(played[0], played[1])
    assert torch.equal(played[0], played[2])
    assert torch.equal(as_policy(straight)(theta[:, 0], x0, theta), straight(theta[:, 0], x0, theta))
    diary = Diary()
    assert as_policy(diary) is diary


def test_a_receding_horizon_can_be_used_again() -> None:
    policy = RecedingHorizon(Walkers())
    found = [rollout(Walkers(), policy, *walkers(count), 0.2) for count in (2, 2, 1)]
    fresh = [rollout(Walkers(), RecedingHorizon(Walkers()), *walkers(count), 0.2) for count in (2, 1)]
    assert torch.equal(found[0].x, found[1].x)
    assert torch.equal(found[0].x, fresh[0].x)
    assert torch.equal(found[2].x, fresh[1].x)
    assert policy.solves.tolist() == [5], "counts are those of the last episodes"
