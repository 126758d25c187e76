"""`check_game` accepts games that keep the contract and names what is broken in games that do not."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hno.games import Box, CollisionAvoidance, ControlAffineGame, Game, make
from hno.games.kinematics import distances, double_integrator_drift
from hno.games.potential import GAP, potential_gap, require_potential
from hno.games.testing import ContractError, check_game
from tests.crossing import Crossing, Merging
from tests.lq import random_game


class Encounter(ControlAffineGame):
    """Points in the plane that keep apart: the sound game that every broken one below changes in one place."""

    def __init__(self) -> None:
        super().__init__()
        self.horizon, self.label_step = 2.0, 0.25
        self.state_box = Box([[-4.0] * 4] * 2, [[4.0] * 4] * 2)
        self.initial_box = Box([[-1.0] * 4] * 2, [[1.0] * 4] * 2)
        self.control_box = Box([-1.0, -2.0], [1.0, 3.0])
        self.type_box = Box([1.0, 1.0], [5.0, 5.0])
        self.register_buffer("input_matrix", torch.eye(4)[:, 2:])
        self.register_buffer("effort_weight", torch.tensor([2.0, 0.5]))

    def drift(self, x: Tensor) -> Tensor:
        return double_integrator_drift(x)

    def positions(self, x: Tensor) -> Tensor:
        return x[..., :2]

    def terminal_value(self, x: Tensor) -> Tensor:
        return -x.square().sum(-1)

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        return 0.1 * theta.sum(-1)[..., None, None] - distances(self.positions(x))

    def sensors(self, theta: Tensor) -> Tensor:
        return theta.unsqueeze(-1).expand(*theta.shape, 3) / 5


class FreeEncounter(Game):
    """The same game, whose effort and best response are not derived."""

    def __init__(self) -> None:
        super().__init__()
        game = Encounter()
        self.horizon, self.label_step = game.horizon, game.label_step
        self.state_box, self.initial_box = game.state_box, game.initial_box
        self.control_box, self.type_box = game.control_box, game.type_box
        self.register_buffer("weight", game.effort_weight)

    positions, terminal_value, constraint = Encounter.positions, Encounter.terminal_value, Encounter.constraint

    def dynamics(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([x[..., 2:], u], -1)

    def effort(self, u: Tensor) -> Tensor:
        return (self.weight * u.square()).sum(-1)

    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        return self.control_box.clamp(own_costate[..., 2:] / (2 * self.weight))


class CoupledDynamics(Encounter):
    def drift(self, x: Tensor) -> Tensor:
        return super().drift(x) + 0.01 * x.flip(-2)


class CoupledEffort(FreeEncounter):
    def effort(self, u: Tensor) -> Tensor:
        return super().effort(u) + 0.1 * u.square().sum((-2, -1)).unsqueeze(-1)


class CoupledResponse(FreeEncounter):
    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        return super().best_response(x, own_costate.mean(-2, keepdim=True).expand_as(own_costate))


class DifferentTargets(Encounter):
    def terminal_value(self, x: Tensor) -> Tensor:
        return -(x[..., 0] - torch.tensor([1.0, 2.0], dtype=x.dtype)).square()


class DifferentSensors(Encounter):
    def sensors(self, theta: Tensor) -> Tensor:
        return theta[..., :1].unsqueeze(-1).expand(*theta.shape, 3)


class DifferentBoxes(Encounter):
    def __init__(self) -> None:
        super().__init__()
        self.state_box = Box([[-4.0] * 4] * 2, [[4.0] * 4, [5.0] * 4])


class BareNorm(Encounter):
    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        distance = self.positions(x).diff(dim=-2).square().sum(-1).sqrt()
        return 0.1 * theta.sum(-1)[..., None, None] - distance.unsqueeze(-1).expand(*theta.shape, 1)


class MirroredBareNorm(Encounter):
    def positions(self, x: Tensor) -> Tensor:
        return torch.stack([x[..., 0, :2], 1.75 - x[..., 1, :2]], -2)

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        distance = self.positions(x).diff(dim=-2).square().sum(-1).sqrt()
        return 0.1 * theta.sum(-1)[..., None, None] - distance.unsqueeze(-1).expand(*theta.shape, 1)


class KinkedTerminal(Encounter):
    def terminal_value(self, x: Tensor) -> Tensor:
        return -x.abs().pow(1.5).sum(-1)


class TwiceTheVertex(FreeEncounter):
    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        return super().best_response(x, 2 * own_costate)


class SlightlyOff(FreeEncounter):
    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        return super().best_response(x, 1.02 * own_costate)


class Minimiser(FreeEncounter):
    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        return super().best_response(x, -own_costate)


class Unclamped(FreeEncounter):
    def best_response(self, x: Tensor, own_costate: Tensor) -> Tensor:
        return own_costate[..., 2:] / (2 * self.weight)


class FixedBatch(Encounter):
    def terminal_value(self, x: Tensor) -> Tensor:
        return -torch.stack([x[:, 0, 0], x[:, 1, 0]], -1)


class OtherShape(FreeEncounter):
    def effort(self, u: Tensor) -> Tensor:
        return super().effort(u).unsqueeze(-1)


class DoubleConstant(Encounter):
    def terminal_value(self, x: Tensor) -> Tensor:
        return super().terminal_value(x) + torch.ones(2, dtype=torch.float64)


class FloatConstant(Encounter):
    def terminal_value(self, x: Tensor) -> Tensor:
        return torch.mv(torch.ones(2, 2), x[..., 0].flatten()[:2]).expand(x.shape[:-1])


class InfiniteCost(Encounter):
    def terminal_value(self, x: Tensor) -> Tensor:
        return -x.sqrt().sum(-1)


class NoSensors(Encounter):
    def sensors(self, theta: Tensor) -> Tensor:
        return super().sensors(theta)[..., :0]


class OnALine(Encounter):
    def positions(self, x: Tensor) -> Tensor:
        return x[..., :1]


class RewardedViolation(Encounter):
    penalty_height = -1e4


class TurnedSign(Encounter):
    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        return -super().constraint(x, theta)


class CostForReward(Encounter):
    def terminal_value(self, x: Tensor) -> Tensor:
        return -super().terminal_value(x)


class RewardForCost(Encounter):
    def state_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        return -x.square().sum(-1)


class WayTravelled(Encounter):
    """Everybody wants to get far away, in whatever direction."""

    def terminal_value(self, x: Tensor) -> Tensor:
        return x[..., :2].square().sum(-1).add(1).sqrt()


class Speed(Encounter):
    """Everybody likes to move."""

    def state_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        return -x[..., 2:].square().sum(-1).add(1).sqrt()


class OneStateDrift(Encounter):
    def drift(self, x: Tensor) -> Tensor:
        return x[..., 2:3]


class PlayersFirst(Encounter):
    """Right for one state, and where there are as many rows as players."""

    def drift(self, x: Tensor) -> Tensor:
        found = torch.zeros_like(x)
        for player in range(self.players):
            found[player] = double_integrator_drift(x[player])
        return found


class HalfSquare(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return x.square()

    @staticmethod
    def backward(ctx, slope):
        return slope * ctx.saved_tensors[0]


class WrongGradient(Encounter):
    def terminal_value(self, x: Tensor) -> Tensor:
        return -HalfSquare.apply(x).sum(-1)


class NoGradient(Encounter):
    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        return super().constraint(x, theta).detach()


class ReversedPenalty(Encounter):
    def penalty(self, x: Tensor, theta: Tensor) -> Tensor:
        return 1e4 - super().penalty(x, theta)


class NoStateBox(Encounter):
    def __init__(self) -> None:
        super().__init__()
        del self.state_box


class NoSuchState(Encounter):
    periodic = (4,)


class NotPeriodic(Encounter):
    periodic = (0,)


class NegativeRadius(Encounter):
    positive = ("radius",)
    radius = -1.0


class OwnSoftConstraint(Encounter):
    def soft_constraint(self, constraint: Tensor) -> Tensor:
        return -constraint


class Drifting(Encounter):
    calls = 0

    def constraint(self, x: Tensor, theta: Tensor) -> Tensor:
        self.calls += 1
        return super().constraint(x, theta) + 0.1 * self.calls


class OutsideStart(Encounter):
    def __init__(self) -> None:
        super().__init__()
        self.initial_box = Box([[-5.0] * 4] * 2, [[1.0] * 4] * 2)


class OddHorizon(Encounter):
    def __init__(self) -> None:
        super().__init__()
        self.horizon = 2.1


class OnePlayerBox(Encounter):
    def __init__(self) -> None:
        super().__init__()
        self.initial_box = Box([-1.0] * 4, [1.0] * 4)


class FrozenChannel(Encounter):
    def __init__(self) -> None:
        super().__init__()
        self.control_box = Box([-1.0, 0.0], [1.0, 0.0])


class PenaltyCountedTwice(Encounter):
    potential = True

    def potential_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        return self.penalty(x, theta).sum(-1)


class PenaltyBorneAlone(Encounter):
    potential, roles = True, (0, 1)

    def penalty(self, x: Tensor, theta: Tensor) -> Tensor:
        return super().penalty(x, theta) * torch.tensor([1.0, 0.0], dtype=x.dtype)


class RewardOfCompany(Encounter):
    potential = True

    def terminal_value(self, x: Tensor) -> Tensor:
        return super().terminal_value(x) - (x - x.flip(-2)).square().sum(-1)


class RewardOfTheOther(Encounter):
    potential = True

    def terminal_value(self, x: Tensor) -> Tensor:
        return super().terminal_value(x) - x[..., 0].square().flip(-1)


@pytest.mark.parametrize("name", ["narrow_road", "lane_change", "drone"])
def test_the_games_of_the_paper_keep_the_contract(name):
    check_game(make(name))


@pytest.mark.parametrize("players", [2, 3])
def test_a_game_with_a_custom_penalty_keeps_the_contract(players):
    check_game(random_game(players))


def test_a_game_whose_best_response_is_its_own_keeps_the_contract():
    check_game(FreeEncounter())


def test_a_plain_game_keeps_the_contract_and_is_left_alone():
    game = Encounter()
    check_game(game)
    assert game.state_box.lo.dtype == torch.float32
    assert game.fingerprint() == Encounter().fingerprint()


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (
            CoupledDynamics,
            r"dynamics of each player that depends on its own .*outside .* adjoints .*joint cost",
        ),
        (CoupledEffort, r"effort of each player that depends on its own .*Couple the players through `constraint`"),
        (CoupledResponse, r"best_response of each player that depends on its own .*Couple the players through"),
        (DifferentTargets, r"terminal_value to swap .*declare roles = \(0, 1\)"),
        (DifferentSensors, r"sensors to swap .*declare roles = \(0, 1\)"),
        (DifferentBoxes, r"state_box to swap .*declare roles = \(0, 1\)"),
        (BareNorm, r"finite first derivatives of constraint where the players' positions coincide; .*distances"),
        (MirroredBareNorm, r"finite first derivatives of constraint where the players' positions coincide; "),
        (KinkedTerminal, r"finite second derivatives of terminal_value at the centres of the boxes"),
        (TwiceTheVertex, r"no other control in control_box raises; got a gain of .*exact maximiser"),
        (SlightlyOff, r"no other control in control_box raises; got a gain of .*exact maximiser"),
        (Minimiser, r"no other control in control_box raises; got a gain of .*exact maximiser"),
        (Unclamped, r"optimal_control inside control_box; got an excess of .*Clamp"),
        (FixedBatch, r"terminal_value to accept batch shape \(\) in torch.float32; got IndexError.*last axes"),
        (OtherShape, r"effort of shape \(2,\); got \(2, 1\)"),
        (DoubleConstant, r"terminal_value of torch.float32 .*got torch.float64.*buffers"),
        (FloatConstant, r"terminal_value to accept batch shape \(\) in torch.float64; got RuntimeError.*buffers"),
        (InfiniteCost, r"finite terminal_value in state_box; got .*nan"),
        (NoSensors, r"sensors of shape \(2, 1\); got \(2, 0\)"),
        (OnALine, r"positions of shape \(2, 2\); got \(2, 1\)"),
        (RewardedViolation, r"positive constants; got: RewardedViolation needs a positive penalty_height; got -10000"),
        (NegativeRadius, r"positive constants; got: NegativeRadius needs a positive radius; got -1"),
        (OwnSoftConstraint, r"a soft_constraint that grows with the constraint; .*Safe is a constraint below 0"),
        (ReversedPenalty, r"a penalty that is larger where constraints are violated; got .*Mind signs"),
        (TurnedSign, r"an initial_box where players are mostly safe; got .*turn its sign"),
        (CostForReward, r"a terminal_value that is a reward; .*V = -J"),
        (RewardForCost, r"a state_cost that is a cost; .*V = -J"),
        (OneStateDrift, r"drift of shape \(2, 4\); got \(2, 1\).*Index the last axes"),
        (PlayersFirst, r"dynamics to answer each row of a batch as if alone; .*the first ones are the batch"),
        (WrongGradient, r"derivatives of terminal_value that are those of its values; .*the derivative of its forward"),
        (NoGradient, r"derivatives of constraint that are those of its values; .*No detach"),
        (NoStateBox, r"an attribute state_box; got none.*constructor"),
        (NoSuchState, r"places 0 to 3 in `periodic`; got \(4,\)"),
        (NotPeriodic, r"repeats after one edge of state_box along the periodic state 0; .*2 pi"),
        (Drifting, r"one fingerprint for one game; .*pure functions"),
        (OutsideStart, r"initial_box inside state_box; got .*-5.0.*Widen state_box"),
        (OddHorizon, r"a whole multiple of label_step; got horizon 2.1 s, label_step 0.25 s"),
        (OnePlayerBox, r"initial_box of shape \(2, 4\); got \(4,\).*one row per entry of `roles`"),
        *(
            (game, r"a player's deviation to change its own cost as much as the potential; got .*counted once")
            for game in (PenaltyCountedTwice, PenaltyBorneAlone, RewardOfCompany, RewardOfTheOther)
        ),
        (FrozenChannel, r"positive edges of control_box; got \[2.0, 0.0\]"),
    ],
)
def test_a_broken_promise_is_named_with_its_remedy(broken, message):
    with pytest.raises(ContractError, match=r"(?s)Expected .*" + message):
        check_game(broken())


@pytest.mark.parametrize("broken", [PenaltyCountedTwice, PenaltyBorneAlone, RewardOfCompany, RewardOfTheOther])
def test_a_game_that_is_no_potential_game_is_sound_unless_it_says_that_it_is_one(broken):
    assert potential_gap(broken()) > 1e-3
    with pytest.raises(ValueError, match=rf"{broken.__name__} misses by .* of the cost: .*function=value"):
        require_potential(broken())
    game = broken()
    game.potential = False
    check_game(game)


class SharedOnce(PenaltyBorneAlone):
    def potential_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        return self.penalty(x, theta)[..., 0]


def test_a_penalty_of_one_player_alone_makes_no_potential():
    """Also where it counts once: when the other deviates, its own cost stays and the potential changes."""
    assert potential_gap(SharedOnce()) > 1e-3


class Alone(Encounter):
    potential, roles = True, (0, 1)

    def penalty(self, x: Tensor, theta: Tensor) -> Tensor:
        """For each player's distance from the origin."""
        return self.soft_constraint(0.2 * theta - x[..., :2].square().sum(-1).add(1e-6).sqrt())

    def potential_cost(self, x: Tensor, theta: Tensor) -> Tensor:
        return self.penalty(x, theta).sum(-1)


@pytest.mark.parametrize(
    "game",
    [*map(make, ("narrow_road", "lane_change", "drone", "intersection")), Merging(2), Merging(3), Crossing(3), Alone()],
    ids=lambda game: type(game).__name__,
)
def test_what_players_share_counts_once_in_a_potential(game):
    assert game.potential
    assert potential_gap(game) < GAP
    assert potential_gap(game.double()) < 1e-12
    require_potential(game)


def test_a_game_with_declared_roles_may_treat_players_differently():
    game = DifferentTargets()
    game.roles = (0, 1)
    check_game(game)


class Pursuit(Encounter):
    roles = (0, 1)

    def terminal_value(self, x: Tensor) -> Tensor:
        apart = x[..., :2].diff(dim=-2).square().sum((-2, -1))
        return torch.stack([-apart, apart], -1)


def test_opposed_interests_are_pointed_out():
    with pytest.warns(UserWarning, match=r"Players \[0, 1\] have opposed interests"):
        check_game(Pursuit())


@pytest.mark.parametrize(("game", "name"), [(WayTravelled, "terminal_value"), (Speed, "state_cost")])
def test_rewards_that_grow_with_distance_are_allowed_and_said(game, name):
    """What grows with its square in every direction is a cost with the wrong sign (`CostForReward`)."""
    with pytest.warns(UserWarning, match=rf"{name} is one that .* without bound for all players\. .*If that is meant"):
        check_game(game())


def test_shared_interests_are_not(recwarn):
    check_game(random_game(3))
    check_game(Encounter())
    assert not recwarn.list


def test_keeping_distance_takes_two():
    with pytest.raises(TypeError, match="One has one player, and CollisionAvoidance is for two or more"):

        class One(CollisionAvoidance):
            roles = (0,)
