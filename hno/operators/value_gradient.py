"""Value and input gradient of a folded DeepONet as one function that is differentiable in the weights.

The gradient is written as forward operations, and the derivative of both by hand, so that a training step needs one
pass forward and one backward, not the second-order graph that `autograd.grad(..., create_graph=True)` builds.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hno.operators.activations import ClosedFormActivation, Tanh

log = logging.getLogger(__name__)

CPU_BLOCK = 1024
"""Rows that are processed at a time on a CPU: what is kept of them fits into its cache."""
BLOCK = 2**16
"""The same elsewhere."""
KEPT = 2**17
"""Rows beyond which the backward pass computes intermediate values again, block by block, rather than keep them: memory
then grows no longer with the batch, but for its inputs and outputs."""


class Layer(NamedTuple):
    """A hidden layer, core(weight h + bias), with everything else of the activation folded in."""

    weight: Tensor
    """(width, inputs)."""
    bias: Tensor
    """(width,)."""


class _Block(NamedTuple):
    """What the derivatives of some rows need, one entry per hidden layer, from the first."""

    inputs: list[Tensor]
    """h, each (R, inputs), and the last layer's output."""
    firsts: list[Tensor]
    """Derivatives of the core."""
    above: list[Tensor]
    """dV / d output of the layer; times `firsts` it is dV / d argument of the core."""


class Kernels(NamedTuple):
    """The two computations on a block of rows, plain or compiled."""

    forward: Callable[..., tuple[Tensor, Tensor, _Block]]
    """See `_forward`."""
    backward: Callable[..., Tensor]
    """See `_backward`."""


def value_gradient(
    activation: type[ClosedFormActivation],
    y: Tensor,
    which: Tensor,
    coefficient: Tensor,
    layers: Sequence[Layer],
    kernels: Kernels | None = None,
) -> tuple[Tensor, Tensor]:
    """<coefficient[which], h> and its gradient in y, where h is what the layers make of y.

    Args:
        activation: whose core the layers have.
        y: inputs, (R, inputs); the result is not differentiable in them.
        which: row of the coefficients, (R,).
        coefficient: (C, width).
        layers: hidden layers, from the first.
        kernels: `compiled()`; plain ones by default.

    Returns:
        Shapes (R,) and (R, inputs), differentiable in coefficients, weights and biases.
    """
    flat, dtype = [part for layer in layers for part in layer], layers[0].weight.dtype
    y, coefficient = y.to(dtype), coefficient.to(dtype)
    arguments = kernels or Kernels(_forward, _backward), activation, y, which, coefficient, *flat
    value, gradient = _ValueGradient.apply(*arguments)  # type: ignore[no-untyped-call]  # torch does not annotate it
    return value, gradient


class _ValueGradient(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        kernels: Kernels,
        activation: type[ClosedFormActivation],
        y: Tensor,
        which: Tensor,
        coefficient: Tensor,
        *flat: Tensor,
    ) -> tuple[Tensor, Tensor]:
        layers = _layers(flat)
        keep = len(y) <= KEPT and any(ctx.needs_input_grad)
        ctx.kernels, ctx.activation, ctx.blocks = kernels, activation, []
        ctx.save_for_backward(y, which, coefficient, *flat)
        values, gradients = [], []
        with torch.autocast(y.device.type, enabled=False):  # derivatives of half-precision values are not worth much
            for rows, index in _split(y, which):
                value, gradient, block = kernels.forward(activation, rows, coefficient[index], layers)
                values.append(value)
                gradients.append(gradient)
                ctx.blocks += [block] if keep else []
        return torch.cat(values), torch.cat(gradients)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        y, which, coefficient, *flat = ctx.saved_tensors
        forward, backward = ctx.kernels
        layers = _layers(flat)
        sums = [
            part.new_zeros(part.t().shape).t() for part in (coefficient, *flat)
        ]  # for the same reason as in _forward
        parts = zip(_split(y, which), *(part.split(_block(y)) for part in cotangents), strict=True)
        for number, ((rows, index), dvalue, dgradient) in enumerate(parts):
            kept = ctx.blocks[number] if ctx.blocks else forward(ctx.activation, rows, coefficient[index], layers)[2]
            sums[0].index_add_(0, index, backward(ctx.activation, kept, layers, dvalue, dgradient, sums[1:]))
        return None, None, None, None, *sums


def _forward(
    activation: type[ClosedFormActivation], y: Tensor, coefficient: Tensor, layers: Sequence[Layer]
) -> tuple[Tensor, Tensor, _Block]:
    """Value (R,), gradient (R, inputs) and what their derivatives need."""
    inputs, firsts = [y], []
    for weight, bias in layers:
        core, first = activation.core_and_first_(torch.addmm(bias, inputs[-1], weight.mT))
        inputs.append(core)
        firsts.append(first)
    above = [coefficient]
    for (weight, _), first in zip(reversed(layers[1:]), reversed(firsts[1:]), strict=True):
        above.append((above[-1] * first) @ weight)
    gradient = (layers[0].weight.mT @ (above[-1] * firsts[0]).mT).mT  # BLAS is slow where a product has few columns
    return torch.linalg.vecdot(inputs[-1], coefficient), gradient, _Block(inputs, firsts, above[::-1])


def _backward(
    activation: type[ClosedFormActivation],
    block: _Block,
    layers: Sequence[Layer],
    dvalue: Tensor,
    dgradient: Tensor,
    sums: Sequence[Tensor],
) -> Tensor:
    """Add the derivatives in the layers to `sums`; return those in each row's coefficient, (R, width)."""
    curved, dabove = [], dgradient
    for k, (weight, _) in enumerate(layers):  # along the gradient's own computation, backwards: from the inputs up
        above, first = block.above[k], block.firsts[k]
        dbelow = dabove @ weight.mT
        sums[2 * k].addmm_((above * first).mT, dabove)
        dabove = dbelow * first
        curved.append(activation.times_second_(dbelow.mul_(above), block.inputs[k + 1], first))
    rate = dvalue.unsqueeze(-1)
    dcoefficient = dabove.addcmul_(rate, block.inputs[-1])
    dh = rate * block.above[-1]
    for k in reversed(range(len(layers))):  # then along the value's
        du = curved[k].addcmul_(dh, block.firsts[k])
        sums[2 * k].addmm_(du.mT, block.inputs[k])
        sums[2 * k + 1].add_(du.sum(0))
        if k > 0:
            dh = du @ layers[k].weight
    return dcoefficient


@functools.cache
def compiled() -> Kernels | None:
    """The kernels through `torch.compile`, in some ten seconds; None, with a warning, where it does not work."""
    kernels = Kernels(torch.compile(_forward), torch.compile(_backward))
    y, which, coefficient = torch.zeros(8, 3), torch.zeros(8, dtype=torch.int64), torch.zeros(1, 4, requires_grad=True)
    layers = [Layer(torch.zeros(4, 3), torch.zeros(4)), Layer(torch.zeros(4, 4), torch.zeros(4))]
    try:
        value, gradient = value_gradient(Tanh, y, which, coefficient, layers, kernels)
        (value.sum() + gradient.sum()).backward()
    except (RuntimeError, OSError, ImportError) as error:
        log.warning("torch.compile does not work here, so nothing is compiled: %s", str(error).partition("\n")[0])
        return None
    return kernels


def _layers(flat: Sequence[Tensor]) -> list[Layer]:
    return [Layer(*pair) for pair in zip(flat[::2], flat[1::2], strict=True)]


def _block(y: Tensor) -> int:
    return CPU_BLOCK if y.device.type == "cpu" else BLOCK


def _split(y: Tensor, which: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    return zip(y.split(_block(y)), which.split(_block(y)), strict=True)
