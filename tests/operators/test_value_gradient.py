"""Value and input gradient as one function, against autograd in double precision."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from hno.losses import hji_residual
from hno.operators import ValueOperator, activations
from hno.operators import value_gradient as module
from hno.operators.deeponet import DeepONet
from hno.operators.network import Inputs
from hno.operators.value_gradient import Kernels, Layer, compiled, value_gradient
from hno.types import Batch, Field, Labels, Points, Sample
from tests.operators.conftest import ACTIVATIONS, GAMES, MakeModule, MakeOperator, random_points

TIGHT = {"rtol": 1e-11, "atol": 1e-11}


class Problem(NamedTuple):
    """Arguments of `value_gradient`, and a cotangent for each of its results."""

    y: Tensor
    which: Tensor
    coefficient: Tensor
    layers: list[Layer]
    dvalue: Tensor
    dgradient: Tensor

    @property
    def leaves(self) -> list[Tensor]:
        return [self.coefficient, *(part for layer in self.layers for part in layer)]


def problem(rows: int = 23, inputs: int = 4, widths: Sequence[int] = (7, 5, 6), table: int = 3) -> Problem:
    """Random arguments; every row of the table but the last one is somebody's coefficient."""
    generator = torch.Generator().manual_seed(rows)

    def normal(*shape: int, scale: float = 1.0) -> Tensor:
        return scale * torch.randn(shape, generator=generator, dtype=torch.float64)

    sizes = zip((inputs, *widths), widths, strict=False)
    layers = [Layer(normal(b, a, scale=a**-0.5).requires_grad_(), normal(b).requires_grad_()) for a, b in sizes]
    return Problem(
        normal(rows, inputs),
        torch.randint(table - 1, (rows,), generator=generator),
        normal(table, widths[-1]).requires_grad_(),
        layers,
        normal(rows),
        normal(rows, inputs),
    )


def plainly(activation: str, at: Problem) -> tuple[Tensor, Tensor]:
    """The same by `autograd.grad(..., create_graph=True)`."""
    y = at.y.clone().requires_grad_()
    h = y
    for weight, bias in at.layers:
        h = activations.get(activation).core(h @ weight.mT + bias)
    value = (h * at.coefficient[at.which]).sum(-1)
    (gradient,) = torch.autograd.grad(value.sum(), y, create_graph=True)
    return value, gradient


def derivatives(at: Problem, value: Tensor, gradient: Tensor) -> list[Tensor]:
    """In coefficients, weights and biases, of the results against the problem's cotangents; 0 where none depends."""
    total = (value * at.dvalue).sum() + (gradient * at.dgradient).sum()
    found = torch.autograd.grad(total, at.leaves, allow_unused=True)
    return [torch.zeros_like(leaf) if d is None else d for leaf, d in zip(at.leaves, found, strict=True)]


def by_hand(activation: str, at: Problem, kernels: Kernels | None = None) -> tuple[Tensor, Tensor]:
    return value_gradient(activations.get(activation), at.y, at.which, at.coefficient, at.layers, kernels)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("widths", [(6,), (7, 5), (7, 5, 6, 4)])
def test_value_and_gradient_are_those_of_autograd(activation: str, widths: tuple[int, ...]) -> None:
    at = problem(widths=widths)
    for found, expected in zip(by_hand(activation, at), plainly(activation, at), strict=True):
        torch.testing.assert_close(found, expected, **TIGHT)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("widths", [(6,), (7, 5), (7, 5, 6, 4)])
@pytest.mark.parametrize("part", ["value", "gradient", "both"])
def test_derivatives_are_those_of_double_backward(activation: str, widths: tuple[int, ...], part: str) -> None:
    at = problem(widths=widths)
    silent = {"value": {"dgradient": 0 * at.dgradient}, "gradient": {"dvalue": 0 * at.dvalue}, "both": {}}[part]
    at = at._replace(**silent)
    found, expected = (derivatives(at, *results(activation, at)) for results in (by_hand, plainly))
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, **TIGHT)
    assert bool(expected[1].any())


@pytest.mark.parametrize("activation", ["tanh", "sin"])
def test_derivatives_agree_with_finite_differences(activation: str) -> None:
    at = problem(5, 3, (4, 3))

    def function(coefficient: Tensor, *flat: Tensor) -> tuple[Tensor, Tensor]:
        layers = [Layer(*pair) for pair in zip(flat[::2], flat[1::2], strict=True)]
        return value_gradient(activations.get(activation), at.y, at.which, coefficient, layers)

    assert torch.autograd.gradcheck(function, at.leaves)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_result_that_nobody_differentiates_counts_as_zero(activation: str) -> None:
    at = problem()
    for index in (0, 1):
        (ours, theirs) = (f(activation, at)[index].square().sum() for f in (by_hand, plainly))
        found = torch.autograd.grad(ours, at.leaves)
        expected = torch.autograd.grad(theirs, at.leaves, allow_unused=True)
        for mine, other in zip(found, expected, strict=True):
            torch.testing.assert_close(mine, torch.zeros_like(mine) if other is None else other, **TIGHT)


def test_only_some_of_the_parameters_need_a_gradient() -> None:
    at = problem()
    expected = derivatives(at, *plainly("tanh", at))
    for leaf in at.leaves[1:3]:
        leaf.requires_grad_(False)
    value, gradient = by_hand("tanh", at)
    total = (value * at.dvalue).sum() + (gradient * at.dgradient).sum()
    kept = [0, *range(3, len(at.leaves))]
    for found, index in zip(torch.autograd.grad(total, [at.leaves[k] for k in kept]), kept, strict=True):
        torch.testing.assert_close(found, expected[index], **TIGHT)


def test_a_branch_input_without_rows_has_no_derivative() -> None:
    at = problem(table=4)
    found = derivatives(at, *by_hand("sin", at))[0]
    assert found[:3].any(-1).all()
    assert not found[3].any()


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_arguments_are_left_as_they_were(activation: str) -> None:
    """The cores work in place, on memory of their own."""
    at = problem()
    before = [part.detach().clone() for part in (at.y, at.which, *at.leaves, at.dvalue, at.dgradient)]
    derivatives(at, *by_hand(activation, at))
    after = [at.y, at.which, *at.leaves, at.dvalue, at.dgradient]
    assert all(map(torch.equal, before, after))


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_backward_pass_can_run_twice(activation: str) -> None:
    at = problem()
    value, gradient = by_hand(activation, at)
    total = (value * at.dvalue).sum() + (gradient * at.dgradient).sum()
    first = torch.autograd.grad(total, at.leaves, retain_graph=True)
    assert all(map(torch.equal, first, torch.autograd.grad(total, at.leaves)))


@pytest.mark.parametrize("activation", ["tanh", "sin"])
def test_second_derivatives_are_refused_or_right(activation: str) -> None:
    at = problem()
    found = []
    for results in (by_hand, plainly):
        value, gradient = results(activation, at)
        total = value.square().sum() + gradient.square().sum()
        (slope,) = torch.autograd.grad(total, at.layers[0].weight, create_graph=True)
        try:
            found.append(torch.autograd.grad(slope.square().sum(), at.leaves))
        except RuntimeError:
            return
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, **TIGHT)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_mixed_precision_trains(make_operator: MakeOperator, activation: str) -> None:
    operator = make_operator(activation=activation)
    points = random_points(operator.game, 40)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        field = operator.field(points)
        loss = torch.stack([part.float().abs().mean() for part in field]).sum()
    slopes = torch.autograd.grad(loss, list(operator.parameters()), allow_unused=True)
    assert all(slope.dtype == torch.float32 and bool(slope.isfinite().all()) for slope in slopes if slope is not None)
    assert bool(slopes[1].any())


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("block", [1, 5, 23, 24])
@pytest.mark.parametrize("kept", [0, 22, 23])
def test_blocks_and_recomputation_change_nothing(
    monkeypatch: pytest.MonkeyPatch, activation: str, block: int, kept: int
) -> None:
    """23 rows in blocks of 5 leave 3; what is kept up to 22 rows is computed again for 23."""
    at = problem(23)
    whole = by_hand(activation, at)
    expected = derivatives(at, *whole)
    monkeypatch.setattr(module, "CPU_BLOCK", block)
    monkeypatch.setattr(module, "KEPT", kept)
    split = by_hand(activation, at)
    for found, one in zip((*split, *derivatives(at, *split)), (*whole, *expected), strict=True):
        torch.testing.assert_close(found, one, **TIGHT)


class Watched(NamedTuple):
    """What a call of `value_gradient` held at most."""

    forwards: int
    """Blocks that were computed, those of the backward pass included."""
    alive: int
    """Blocks whose intermediate values were alive at once while the next one was computed, and after the call."""


Watch = Callable[[Callable[[], Any]], Watched]


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Watch:
    """Count blocks, and how many of their intermediate values live on."""
    monkeypatch.setattr(module, "CPU_BLOCK", 4)
    original = module._forward

    def run(call: Callable[[], Any]) -> Watched:
        seen: list[weakref.ref[Tensor]] = []
        alive = [0]

        def living() -> int:
            return sum(reference() is not None for reference in seen)

        def forward(*arguments: Any) -> Any:
            alive.append(living())
            found = original(*arguments)
            seen.append(weakref.ref(found[2].firsts[0]))
            return found

        with monkeypatch.context() as patch:
            patch.setattr(module, "_forward", forward)
            result = call()
            alive.append(living())
            del result
        assert living() == 0
        return Watched(len(seen), max(alive))

    return run


def test_every_block_is_kept_for_the_backward_pass_and_computed_once(watch: Watch) -> None:
    at = problem(20)
    assert watch(lambda: by_hand("tanh", at)) == Watched(5, 5)
    assert watch(lambda: derivatives(at, *by_hand("tanh", at))).forwards == 5


def test_beyond_the_limit_one_block_at_a_time_is_computed_again(watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "KEPT", 19)
    at = problem(20)
    found = watch(lambda: derivatives(at, *by_hand("tanh", at)))
    assert found.forwards == 10
    assert found.alive <= 1


def test_nothing_is_kept_where_no_gradient_is_needed(watch: Watch) -> None:
    at = problem(20)
    frozen = at._replace(
        coefficient=at.coefficient.detach(), layers=[Layer(*(part.detach() for part in layer)) for layer in at.layers]
    )
    found = watch(lambda: by_hand("tanh", frozen))
    assert found.forwards == 5
    assert found.alive <= 1
    assert not any(part.requires_grad for part in by_hand("tanh", frozen))


@pytest.mark.parametrize("quiet", [torch.no_grad, torch.inference_mode])
def test_a_policy_keeps_nothing(watch: Watch, make_operator: MakeOperator, quiet: Callable[[], Any]) -> None:
    """Also with weights that are being trained, as closed-loop validation plays them."""
    operator = make_operator()
    points = random_points(operator.game, 20)
    with quiet():
        found = watch(lambda: operator.field(points))
    assert found.forwards == 10
    assert found.alive <= 1


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> list[Callable[..., Any]]:
    """Trace functions as `torch.compile` does, but generate no code; what was traced."""
    original, traced = torch.compile, list[Callable[..., Any]]()

    def trace(function: Callable[..., Any]) -> Callable[..., Any]:
        traced.append(function)
        return original(function, backend="eager")

    torch.compiler.reset()
    monkeypatch.setattr(torch, "compile", trace)
    return traced


def test_compiled_kernels_change_nothing(quickly: list[Callable[..., Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    """In place in the sums too, whatever the activation and the number of rows."""
    kernels = compiled.__wrapped__()
    assert kernels is not None
    assert quickly == [module._forward, module._backward]
    monkeypatch.setattr(module, "CPU_BLOCK", 9)
    for activation, rows, kept in (("tanh", 18, 18), ("sin", 18, 0)):
        monkeypatch.setattr(module, "KEPT", kept)
        at = problem(rows)
        found, expected = by_hand(activation, at, kernels), plainly(activation, at)
        pairs = zip((*found, *derivatives(at, *found)), (*expected, *derivatives(at, *expected)), strict=True)
        for ours, theirs in pairs:
            torch.testing.assert_close(ours, theirs, **TIGHT)


@pytest.mark.parametrize("error", [RuntimeError("no compiler\nat all"), OSError("no disk"), ImportError("no triton")])
def test_without_a_compiler_nothing_is_compiled(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, error: Exception
) -> None:
    def fail(*arguments: Any) -> None:
        raise error

    monkeypatch.setattr(torch, "compile", lambda function: fail)
    with caplog.at_level("WARNING"):
        assert compiled.__wrapped__() is None
    (record,) = caplog.records
    assert str(error).splitlines()[0] in record.getMessage()
    assert "at all" not in record.getMessage()


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_net_folds_its_activations_away(activation: str) -> None:
    """Gain, shift and slope go into the weights, and their derivatives come back to the parameters."""
    torch.manual_seed(0)
    net = DeepONet(Inputs(2, 2, 1, 0, 3), activations.get(activation), width=6, depth=3).double()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.mul_(1.1).add_(0.013)
    generator = torch.Generator().manual_seed(0)
    y = torch.randn(9, 4, generator=generator, dtype=torch.float64).requires_grad_()
    sensors, which = torch.randn(2, 3, generator=generator, dtype=torch.float64), torch.arange(9) % 2
    weights = torch.randn(9, 5, generator=generator, dtype=torch.float64)
    value = net(y, sensors, which)
    (gradient,) = torch.autograd.grad(value.sum(), y, create_graph=True)
    found = net.value_gradient(y.detach(), sensors, which)
    expected = []
    for results in ((value, gradient), found):
        joint = torch.cat([results[0].unsqueeze(-1), results[1]], -1)
        expected.append((joint, torch.autograd.grad((weights * joint).sum(), list(net.parameters()))))
    torch.testing.assert_close(expected[1][0], expected[0][0], **TIGHT)
    for ours, theirs in zip(expected[1][1], expected[0][1], strict=True):
        torch.testing.assert_close(ours, theirs, **TIGHT)


def plain_field(operator: ValueOperator, points: Points) -> Field:
    """A field that autograd differentiates out of `forward`, differentiable in the parameters."""
    tau, x = points.tau.clone().requires_grad_(), points.x.clone().requires_grad_()
    value = operator(tau, x, points.theta)
    rows = [torch.autograd.grad(value[:, i].sum(), (tau, x), create_graph=True) for i in range(value.shape[-1])]
    slope, costate = (torch.stack(part, 1) for part in zip(*rows, strict=True))
    return Field(value, slope, costate)


def plain_loss(operator: ValueOperator, batch: Batch, weights: Mapping[str, float]) -> Tensor:
    """The loss of an HNO, term by term, from `plain_field`."""
    game, scale = operator.game, operator.value_scale
    labels = batch["bvp"].labels
    assert labels is not None
    labelled = plain_field(operator, batch["bvp"].points)
    inside, end = batch["interior"].points, batch["terminal"].points
    residual = hji_residual(game, inside, plain_field(operator, inside))
    size = scale / game.horizon + game.penalty(inside.x, inside.theta)
    terms = {
        "value": (labelled.value - labels.value) / scale,
        "costate": (labelled.costate - labels.costate) / operator.costate_scale,
        "boundary": (operator(*end) - game.terminal_value(end.x)) / scale,
        "residual": residual / size,
    }
    return torch.stack([weights[name] * term.abs().mean() for name, term in terms.items()]).sum()


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("exact", [False, True])
def test_training_step_has_the_gradients_of_a_plain_reference(
    make_module: MakeModule, activation: str, game: str, exact: bool
) -> None:
    weights = {"value": 1.0, "costate": 0.7, "boundary": 0.3, "residual": 0.5}
    module = make_module(game, weights=weights, activation=activation, exact_terminal=exact).double()
    operator = module.operator
    points = [random_points(operator.game, size, seed, types=3) for seed, size in enumerate((9, 7, 5))]
    generator = torch.Generator().manual_seed(1)
    value = -40 * torch.rand(9, 2, generator=generator, dtype=torch.float64)
    costate = 3 * torch.randn(9, 2, *points[0].x.shape[1:], generator=generator, dtype=torch.float64)
    end = points[2]._replace(tau=torch.zeros(5, dtype=torch.float64))
    batch = {
        "bvp": Sample(points[0], Labels(value, costate)), "interior": Sample(points[1]), "terminal": Sample(end),
    }  # fmt: skip
    losses = module.training_step(batch, 0), plain_loss(operator, batch, weights)
    torch.testing.assert_close(losses[0], losses[1], rtol=1e-12, atol=0)
    parameters = dict(operator.named_parameters())
    ours, theirs = (torch.autograd.grad(loss, list(parameters.values()), allow_unused=True) for loss in losses)
    for name, mine, other in zip(parameters, ours, theirs, strict=True):
        other = torch.zeros_like(parameters[name]) if other is None else other
        size = float(other.abs().max())
        torch.testing.assert_close(
            mine, other, rtol=1e-9, atol=1e-11 * max(size, 1.0), msg=lambda m, n=name: f"{n}: {m}"
        )


def test_no_rows_have_no_values() -> None:
    at = problem(4)
    value, gradient = by_hand("tanh", at._replace(y=at.y[:0], which=at.which[:0]))
    assert (value.shape, gradient.shape) == ((0,), (0, 4))
