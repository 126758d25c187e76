"""The neural tangent kernel of a trained operator, J J' over all its parameters (Jacot et al. 2018), and its spectrum.

The rows of J are the gradients of what training makes small: the HJI residual and the deviations of value and costate
from labels, each in the size that the loss measures it in (a stack of residuals as in Wang et al. 2022).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import functional_call, jacrev, vmap

from hno.data.rows import NoLabelsError, rows_of
from hno.evaluation import format as text
from hno.evaluation.sections import Column, Evaluation, ModelSection, sections
from hno.evaluation.spectrum import Spectrum, spectrum, summary
from hno.losses.hji import HJIResidual
from hno.losses.supervised import CostateDeviation, ValueDeviation
from hno.operators import ValueOperator
from hno.types import Extremal, Field, Labels, Points, Sample

TERMS = (HJIResidual(), ValueDeviation(), CostateDeviation())
"""What the rows are gradients of, at each point in this order."""
KINDS = {"kernel": "J J'", "product": "paper's product"}
"""What a section has of each type, and how it is called."""
BLOCK_BYTES = 2**28
"""Memory for the two blocks of J that are multiplied."""

Parameters = dict[str, Tensor]
"""Parameters of an operator, or something for each of them, by name."""


class TypeKernel(NamedTuple):
    """The tangent kernel of an operator at one player type."""

    points: int
    """Points whose residuals are its rows."""
    block: int
    """Rows of J that were held at a time, twice."""
    kernel: Spectrum
    """Of J J'."""
    product: Spectrum | None
    """Of the element-wise product of trunk's and branch's, which the paper calls the tangent kernel; None without."""


def type_kernel(operator: ValueOperator, found: Extremal, rows: int, seed: int = 0) -> TypeKernel:
    """The tangent kernel at points drawn along labels of one type.

    The end of the game is left out: where the boundary condition holds by construction, nothing can be learned there.

    Args:
        operator: whose parameters; it is not changed.
        found: labels of one type.
        rows: of the kernel, at most; fewer if the labels have fewer points.
        seed: of the draw, which is without replacement.

    Raises:
        ValueError: labels of several types, or fewer rows than one point has.
        NoLabelsError: no label converged.
    """
    sample, each = rows_of(operator.game, [found]), rows_per_point(operator)
    sample = sample.rows(sample.points.tau > 0)
    if rows < each:
        raise ValueError(f"A tangent kernel has {each} rows for each point; got {rows} rows, which is less than one.")
    if len(found.theta.unique(dim=0)) != 1:
        raise ValueError("A tangent kernel is that of one type; pass the labels of each type on their own.")
    drawn = torch.randperm(sample.size, generator=torch.Generator().manual_seed(seed))[: rows // each]
    first, *others = tangent_kernels(operator, sample.rows(drawn))
    kernel = sum(others, first)
    product = spectrum(first.mul_(others.pop())) if others else None  # in place: kernels are large
    return TypeKernel(len(drawn), min(len(drawn), points_per_block(operator)) * each, spectrum(kernel), product)


def rows_per_point(operator: ValueOperator) -> int:
    """Residuals of all players at one point: HJI, value and every costate."""
    players, states = operator.game.players, operator.game.state_dim
    return players * (2 + players * states)


def points_per_block(operator: ValueOperator, memory: int = BLOCK_BYTES) -> int:
    """Points of which two blocks of J take no more than `memory` bytes, but at least one."""
    row = 8 * sum(parameter.numel() for parameter in operator.parameters())
    return max(1, memory // (2 * row * rows_per_point(operator)))


def tangent_kernels(operator: ValueOperator, sample: Sample, memory: int = BLOCK_BYTES) -> list[Tensor]:
    """J J' over each of the `parameter_groups` of an operator; the tangent kernel is their sum.

    J is never there as a whole: blocks of its rows are computed as they are needed, again for every pair of them, which
    costs little beside their product.

    Args:
        operator: see `type_kernel`.
        sample: B labelled points of one type.
        memory: bytes for two blocks.

    Returns:
        Matrices (N, N) in float64, N = B * `rows_per_point`; the rows of a point follow each other.
    """
    each, groups = rows_per_point(operator), parameter_groups(operator)
    blocks = torch.arange(sample.size).split(points_per_block(operator, memory))
    places = [slice(each * int(block[0]), each * (int(block[-1]) + 1)) for block in blocks]
    kernels = [operator.value_scale.new_zeros((each * sample.size,) * 2, dtype=torch.float64) for _ in groups]
    for row, (here, block) in enumerate(zip(places, blocks, strict=True)):
        ours = jacobian(operator, sample.rows(block))
        for there, other in zip(places[: row + 1], blocks[: row + 1], strict=True):
            theirs = ours if other is block else jacobian(operator, sample.rows(other))
            for kernel, names in zip(kernels, groups, strict=True):
                rows, columns = (torch.cat([part[name] for name in names], 1) for part in (ours, theirs))
                product = rows @ columns.mT
                kernel[here, there], kernel[there, here] = product, product.mT
    return kernels


def parameter_groups(operator: ValueOperator) -> list[list[str]]:
    """Names of the trunk's and of the branch's parameters; of all in one group where there are no such two nets."""
    names = [name for name, _ in operator.named_parameters()]
    branch = [name for name in names if ".branch." in name]
    if not branch or not any(".trunk." in name for name in names):
        return [names]
    return [[name for name in names if name not in branch], branch]


def jacobian(operator: ValueOperator, sample: Sample) -> Parameters:
    """Gradients of all residuals at some points, (B * `rows_per_point`, size of the parameter) for each parameter.

    Args:
        operator: see `type_kernel`.
        sample: B labelled points of one type.
    """
    operator = copy.deepcopy(operator).double()
    parameters = {name: tensor.detach() for name, tensor in operator.named_parameters()}
    labels, like = sample.labels, operator.value_scale
    assert labels is not None
    theta = sample.points.theta[0].to(like)

    def gradients(tau: Tensor, x: Tensor, value: Tensor, costate: Tensor) -> Parameters:
        point = Sample(Points(tau, x, theta), Labels(value, costate))
        return jacrev(lambda changed: residuals(operator, changed, point))(parameters)

    columns = sample.points.tau, sample.points.x, labels.value, labels.costate
    found = vmap(gradients)(*(column.to(like) for column in columns))
    return {name: gradient.reshape(gradient.shape[:2].numel(), -1) for name, gradient in found.items()}


def residuals(operator: ValueOperator, parameters: Parameters, point: Sample) -> Tensor:
    """All residuals at one point, in the sizes that the loss measures them in, (`rows_per_point`,).

    Derivatives in the point are those of `operator.forward`: `operator.field` has a derivative written by hand, which
    torch.func cannot differentiate.

    Args:
        operator: everything but the parameters.
        parameters: its own, by name.
        point: labelled, without a batch axis.
    """
    tau, x, theta = point.points

    def value(tau: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        batch = tau.unsqueeze(0), x.unsqueeze(0), theta.unsqueeze(0)
        found = functional_call(operator, parameters, batch).squeeze(0)
        return found, found

    (in_time, in_state), found = jacrev(value, argnums=(0, 1), has_aux=True)(tau, x)
    view = operator.view(point, Field(found, in_time, in_state))
    parts = [term.residual(view) / term.scale(view) for term in TERMS]
    return torch.cat([part.flatten() for part in parts])


def check_rows(operator: ValueOperator, rows: object) -> None:
    """Refuse an operator of several nets or without weights, and fewer rows than one point has.

    Raises:
        ValueError: one of these.
    """
    if next(operator.parameters(), None) is None:
        raise ValueError("ntk=true needs the operator's weights: name its checkpoint, not an exported controller.")
    if operator.potential:
        raise ValueError(
            "ntk=true is for the players' values, which function=value learns; this operator learns a potential."
        )
    members, least = len(operator.members), rows_per_point(operator)
    if members > 1:
        raise ValueError(f"ntk=true is for one net, this operator has {members}. Train it with function.members=1.")
    if not (type(rows) is int and rows >= least):
        raise ValueError(f"ntk_rows must be a whole number of at least {least}, the rows of one point; got {rows!r}.")


def type_entry(operator: ValueOperator, found: Extremal, rows: int, seed: int) -> dict[str, Any]:
    """JSON content of the kernel at one type; a product is None where a network has no trunk and branch."""
    theta = found.theta[0].tolist()
    try:
        kernel = type_kernel(operator, found, rows, seed)
    except NoLabelsError as error:
        return {"theta": theta, "reason": str(error), "points": 0, "block": None, **dict.fromkeys(KINDS)}
    spectra = {"kernel": summary(kernel.kernel), "product": kernel.product and summary(kernel.product)}
    return {"theta": theta, "reason": None, "points": kernel.points, "block": kernel.block, **spectra}


@sections.register("ntk")
class TangentKernel(ModelSection):
    """The spectrum of the tangent kernel at every type of the training run."""

    heading = "Neural tangent kernel"
    note = (
        "rank: eigenvalues above rows * 2.2e-16 of the largest, the others are rounding; condition: largest over "
        "smallest eigenvalue; effective rank: exp of the eigenvalues' entropy; product: of trunk's and branch's kernel"
    )
    columns = (
        Column("theta", "theta", format=text.types),
        Column("points", "points", format=text.whole),
        Column("kind", "kernel"),
        Column("condition", "condition"),
        Column("rank", "rank"),
        Column("effective_rank", "effective rank", format=lambda rank: text.number(rank, 1)),
        Column("largest", "largest eigenvalue", format=lambda value: "n/a" if value is None else f"{value:.2e}"),
    )

    def check(self, evaluation: Evaluation) -> None:
        """Raises ValueError as `check_rows`, and where no type of the training run is evaluated."""
        check_rows(evaluation.policy.operator, evaluation.options["ntk_rows"])
        if not set(evaluation.types) & set(evaluation.seen):
            seen = "; ".join(",".join(f"{t:g}" for t in theta) for theta in evaluation.seen) or "none"
            raise ValueError(f'ntk=true needs a type of the training run among theta; these are "{seen}".')

    def compute(self, evaluation: Evaluation) -> list[dict[str, Any]]:
        """One entry for every evaluated type that the operator was trained with."""
        seen = [found for found in evaluation.labels if tuple(found.theta[0].tolist()) in evaluation.seen]
        rows, seed = evaluation.options["ntk_rows"], evaluation.options["seed"]
        return [type_entry(evaluation.policy.operator, found, rows, seed) for found in seen]

    def rows(self, content: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Two lines per type, one of each kernel."""
        return [
            {"theta": entry["theta"], "points": entry["points"], "kind": name, **_spectrum(entry[kind])}
            for entry in content
            for kind, name in KINDS.items()
        ]


def _spectrum(found: Mapping[str, Any] | None) -> dict[str, Any]:
    """Of a spectrum that is cut off, a bound of the condition number."""
    if found is None or found["condition"] is None:
        return dict.fromkeys(("condition", "rank", "effective_rank", "largest"))
    resolved = found["rank"] == found["rows"]
    return {
        "condition": f"{found['condition']:.2e}" if resolved else f"> {1 / found['cutoff']:.2e}",
        "rank": f"{found['rank']} of {found['rows']}",
        "effective_rank": found["effective_rank"],
        "largest": found["curve"][0][1],
    }
