from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from hno.data.rows import NoLabelsError, rows_of
from hno.evaluation import ntk
from hno.evaluation.ntk import (
    TangentKernel,
    jacobian,
    points_per_block,
    residuals,
    rows_per_point,
    tangent_kernels,
    type_entry,
    type_kernel,
)
from hno.evaluation.spectrum import spectrum
from hno.games import make
from hno.losses import Scales, losses
from hno.operators import ValueOperator, make_operator
from hno.operators.deeponet import MLP
from hno.operators.gradient import GradientOperator
from hno.operators.network import Inputs, Network
from hno.types import Labels, Points, Sample, Status, join
from tests.fakes import fake_labels, small_architecture

GAMES = ("narrow_road", "lane_change", "drone")


def small(game: str = "narrow_road", activation: str = "tanh", **options: Any) -> ValueOperator:
    """A small HNO with random weights whose outputs have sizes of their own."""
    torch.manual_seed(0)
    operator = make_operator(
        make(game), small_architecture(activation, **({"width": 8, "exact_terminal": False} | options))
    )
    sizes = 1 + torch.arange(operator.costate_scale.numel()).view_as(operator.costate_scale) / 7
    operator.set_scales(Scales(torch.tensor(40.0), sizes))
    return operator


def some_points(operator: ValueOperator, count: int = 4, theta: tuple[float, float] = (2.0, 4.0)) -> Sample:
    """Labelled points of one type, the first of them at the end of the game."""
    sample = rows_of(operator.game, [fake_labels(operator.game, theta, 2)])
    end = int(sample.points.tau.argmin())
    return sample.rows(torch.tensor([end, *range(1, count)]))


def double(sample: Sample) -> Sample:
    """The sample in float64, without its table of types."""
    assert sample.labels is not None
    return Sample(Points(*map(Tensor.double, sample.points)), Labels(*map(Tensor.double, sample.labels)))


def training_residuals(operator: ValueOperator, sample: Sample) -> Tensor:
    """What training makes small, through the field and the loss terms of an operator in float64, (rows,)."""
    view = operator.view(sample, operator.field(sample.points))
    terms = (losses.get(name)() for name in ("residual", "value", "costate"))
    return torch.cat([(term.residual(view) / term.scale(view)).flatten(1) for term in terms], 1).flatten()


def dense_jacobian(operator: ValueOperator, sample: Sample) -> Tensor:
    """J as torch.autograd gives it, row by row."""
    operator = copy.deepcopy(operator).double()
    rows, parameters = training_residuals(operator, double(sample)), list(operator.parameters())
    gradients = [torch.autograd.grad(row, parameters, retain_graph=True, materialize_grads=True) for row in rows]
    return torch.stack([torch.cat([part.flatten() for part in gradient]) for gradient in gradients])


def close(found: Tensor, expected: Tensor) -> None:
    """Equal to rounding, relative to the largest entry."""
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12 * float(expected.abs().max()))


@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("activation", ["tanh", "sin", "relu"])
@pytest.mark.parametrize("exact", [False, True])
def test_kernel_is_that_of_the_dense_jacobian(game: str, activation: str, exact: bool) -> None:
    operator = small(game, activation, exact_terminal=exact)
    sample = some_points(operator)
    dense = dense_jacobian(operator, sample)
    assert dense.shape == (4 * rows_per_point(operator), sum(p.numel() for p in operator.parameters()))
    trunk, branch = tangent_kernels(operator, sample)
    close(trunk + branch, dense @ dense.mT)
    split = sum(parameter.numel() for parameter in operator.networks[0].trunk.parameters())
    close(trunk, dense[:, :split] @ dense[:, :split].mT)
    close(branch, dense[:, split:] @ dense[:, split:].mT)


@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("exact", [False, True])
def test_rows_are_gradients_of_what_training_makes_small(game: str, exact: bool) -> None:
    operator = small(game, exact_terminal=exact).double()
    sample = double(some_points(operator))
    assert sample.labels is not None
    parameters = {name: tensor.detach() for name, tensor in operator.named_parameters()}
    found = [
        residuals(operator, parameters, Sample(Points(*point), Labels(*label)))
        for point, label in zip(zip(*sample.points, strict=True), zip(*sample.labels, strict=True), strict=True)
    ]
    close(torch.cat(found), training_residuals(operator, sample).detach())


def test_kernel_of_a_linear_net_is_known() -> None:
    """<W y + b, U a + c> has the kernels <B, B'> (<y, y'> + 1) and <T, T'> (<a, a'> + 1)."""
    operator = small(depth=1)
    sizes, activation = operator.encoding.sizes, operator.networks[0].trunk.activation
    operator.networks[0].trunk = MLP((sizes.total, 8), activation)
    operator.networks[0].branch = MLP((sizes.sensors, 8), activation)
    sample = some_points(operator, 3)
    trunk, branch = tangent_kernels(operator, sample)
    each, players = rows_per_point(operator), operator.game.players
    values = torch.tensor([each * point + players + i for point in range(3) for i in range(players)])
    net, game = copy.deepcopy(operator).double(), copy.deepcopy(operator.game).double()
    y = net.encoding(*map(Tensor.double, sample.points)).flatten(0, 1)
    a = game.sensors(sample.points.theta.double()).flatten(0, 1)
    outer_trunk, outer_branch = net.networks[0].trunk(y), net.networks[0].branch(a)
    close(trunk[values][:, values], (outer_branch @ outer_branch.mT * (y @ y.mT + 1)).detach())
    close(branch[values][:, values], (outer_trunk @ outer_trunk.mT * (a @ a.mT + 1)).detach())


@pytest.mark.parametrize("points", [1, 2, 3, 4])
def test_blocks_give_the_kernel_of_one_block(monkeypatch: pytest.MonkeyPatch, points: int) -> None:
    operator = small()
    sample = some_points(operator, 5)
    whole = tangent_kernels(operator, sample)
    memory, sizes = points * 2 * jacobian_bytes(operator, sample) // 5, list[int]()

    def watched(operator: ValueOperator, block: Sample) -> dict[str, Tensor]:
        sizes.append(block.size)
        return jacobian(operator, block)

    monkeypatch.setattr(ntk, "jacobian", watched)
    assert points_per_block(operator, memory) == points
    for kernel, expected in zip(tangent_kernels(operator, sample, memory), whole, strict=True):
        close(kernel, expected)
    assert max(sizes) == points


def jacobian_bytes(operator: ValueOperator, sample: Sample) -> int:
    """Memory of J."""
    return sum(part.numel() * part.element_size() for part in jacobian(operator, sample).values())


def test_a_block_has_a_point_at_least() -> None:
    operator = small()
    sample = some_points(operator, 2)
    close(tangent_kernels(operator, sample, memory=1)[0], tangent_kernels(operator, sample)[0])


def test_kernels_are_symmetric_and_positive_semidefinite() -> None:
    operator = small("drone", "sin")
    for kernel in tangent_kernels(operator, some_points(operator, 6), memory=2**20):
        assert kernel.dtype == torch.float64
        close(kernel, kernel.mT)
        values = torch.linalg.eigvalsh(kernel)
        assert values[0] > -1e-13 * values[-1]


def test_repeated_points_add_no_rank() -> None:
    operator = small()
    sample = some_points(operator, 3)
    once, twice = (
        spectrum(sum(tangent_kernels(operator, sample.rows(torch.tensor(index)))), 1e-12)  # type: ignore[arg-type]
        for index in ([1, 2], [1, 2, 1, 2])
    )
    assert once.rank == 2 * rows_per_point(operator)
    assert twice.rank == once.rank
    torch.testing.assert_close(twice.eigenvalues[: once.rank], 2 * once.eigenvalues)


def test_type_kernel_has_the_sum_and_the_product_of_its_parts() -> None:
    operator = small("lane_change", exact_terminal=True)
    labels = fake_labels(operator.game, (1.3, 5.0), 1)
    found = type_kernel(operator, labels, rows=10**6)
    sample = rows_of(operator.game, [labels])
    trunk, branch = tangent_kernels(operator, sample.rows(sample.points.tau > 0))
    assert found.points == len(labels.t) - 1, "all but the end"
    close(found.kernel.eigenvalues, torch.linalg.eigvalsh(trunk + branch).flip(0))
    assert found.product is not None
    close(found.product.eigenvalues, torch.linalg.eigvalsh(trunk * branch).flip(0))


def test_rows_are_at_most_those_asked_for() -> None:
    operator = small()
    labels, each = fake_labels(operator.game, count=3), rows_per_point(operator)
    found = type_kernel(operator, labels, rows=3 * each + 1)
    assert (found.points, len(found.kernel.eigenvalues), found.block) == (3, 3 * each, 3 * each)
    again, other = (type_kernel(operator, labels, 3 * each, seed) for seed in (0, 1))
    assert torch.equal(again.kernel.eigenvalues, found.kernel.eigenvalues)
    assert not torch.allclose(other.kernel.eigenvalues, found.kernel.eigenvalues)
    assert all(parameter.dtype == torch.float32 and parameter.grad is None for parameter in operator.parameters())


def test_what_makes_no_kernel() -> None:
    operator = small()
    game = operator.game
    with pytest.raises(ValueError, match="one type"):
        type_kernel(operator, join([fake_labels(game, (1.0, 1.0)), fake_labels(game, (1.0, 5.0))]), 200)
    with pytest.raises(ValueError, match="20 rows for each point; got 19"):
        type_kernel(operator, fake_labels(game), 19)
    with pytest.raises(NoLabelsError):
        type_kernel(operator, fake_labels(game, status=[Status.STALLED] * 4), 200)
    operator.networks[0].trunk.activation.slope.data.fill_(float("nan"))
    with pytest.raises(ValueError, match="diverged"):
        type_kernel(operator, fake_labels(game), 40)


class Parametric(Network):
    """A network from outside, without trunk and branch: types beside times and states."""

    def __init__(self, inputs: Inputs, activation: Callable[[], nn.Module]) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(inputs.total + inputs.sensors, 8), nn.Tanh(), nn.Linear(8, 1))

    def forward(self, y: Tensor, sensors: Tensor, which: Tensor) -> Tensor:
        return self.layers(torch.cat([y, sensors[which]], -1)).squeeze(-1)


@pytest.mark.parametrize("exact", [False, True])
def test_a_network_without_trunk_and_branch_has_a_kernel_and_no_product(exact: bool) -> None:
    torch.manual_seed(0)
    operator = GradientOperator(make("narrow_road"), lambda inputs: Parametric(inputs, nn.Tanh), exact)
    sample = some_points(operator)
    dense = dense_jacobian(operator, sample)
    (kernel,) = tangent_kernels(operator, sample, memory=1)
    close(kernel, dense @ dense.mT)
    labels = fake_labels(operator.game, (1.3, 5.0), 1)
    found = type_kernel(operator, labels, rows=10**6)
    sample = rows_of(operator.game, [labels])
    close(
        found.kernel.eigenvalues,
        torch.linalg.eigvalsh(tangent_kernels(operator, sample.rows(sample.points.tau > 0))[0]).flip(0),
    )
    assert found.product is None
    entry = type_entry(operator, labels, 40, 0)
    assert (entry["reason"], entry["product"]) == (None, None)
    assert entry["kernel"]["rows"] == 40
    of_kernel, of_product = TangentKernel().rows([entry])
    assert of_kernel["rank"].endswith("of 40")
    assert {of_product[name] for name in ("condition", "rank", "effective_rank", "largest")} == {None}
