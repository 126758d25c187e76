"""The value operator: a LightningModule around a DeepONet that takes and returns physical units."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import lightning as L
import torch
from torch import Tensor, nn
from torchmetrics import WeightedMeanAbsolutePercentageError

from hno.games import Game, games
from hno.losses import LossTerm, Norm, Scales, used_weights
from hno.operators.deeponet import DeepONet, median_of, nets
from hno.operators.inputs import distinct_types, ego_views, tables
from hno.operators.value_gradient import compiled
from hno.pontryagin.adjoint import terminal_costate
from hno.registry import Registry
from hno.types import Batch, Field, Points, Sample, Types

operators: Registry[ValueOperator] = Registry("operator", "hno.operators")

SPEC_KEY = "hno"
"""Checkpoint entry that says how to build the operator."""
SPEC_FORMAT = 2
"""Version of that entry."""

Optimizer = Callable[[Iterable[nn.Parameter]], Mapping[str, Any]]
"""Builds what Lightning's `configure_optimizers` returns."""


class ValueOperator(L.LightningModule, abc.ABC):
    """V(tau, x, theta) of every player, from one network that sees the game ego-first.

    A subclass is a list of loss terms; everything else is shared.

    Args:
        game: the game.
        activation: registered name.
        activation_options: arguments of the activation, such as the frequency of sin.
        weights: weight of each term by name; terms that are not named weigh 0, names without a term are ignored, so
            that one list serves every operator.
        norm: pointwise norm of the residuals, see `Norm`.
        scaled: measure residuals in the sizes of the labels (see `LossTerm.scale`) rather than in physical units.
        balance: divide every term by its own running mean, so that weights are shares of the gradient of the log loss.
        hardest: share of the collocation points that count, those of the largest residuals.
        width: hidden and output width of trunk and branch.
        depth: hidden layers of trunk and branch.
        exact_terminal: V = -g + (tau / horizon) N rather than N, so that the boundary condition holds exactly and its
            term is left out.
        members: nets that are trained on the same batches from different weights, an odd number; the operator is
            their median.
        optimizer: needed for training only.
    """

    terms: ClassVar[Mapping[str, type[LossTerm]]]
    value_scale: Tensor
    costate_scale: Tensor
    roles: Tensor
    running: Tensor
    """Running mean of each term, 0 before its first step."""

    def __init__(
        self,
        game: Game,
        activation: str = "tanh",
        activation_options: Mapping[str, float] = MappingProxyType({}),
        weights: Mapping[str, float] | None = None,
        norm: str = "l1",
        scaled: bool = True,
        balance: bool = False,
        hardest: float = 1.0,
        width: int = 64,
        depth: int = 4,
        exact_terminal: bool = False,
        members: int = 1,
        optimizer: Optimizer | None = None,
    ) -> None:
        super().__init__()
        self.options = {
            "activation": activation,
            "activation_options": dict(activation_options),
            "width": width,
            "depth": depth,
            "exact_terminal": exact_terminal,
            **({"members": members} if members != 1 else {}),
        }
        self.exact_terminal = exact_terminal
        self.seen_types: list[tuple[float, ...]] = []
        self.config_hash = ""
        self.seed: int | None = None
        self.game = game
        self.optimizer = optimizer
        self.norm, self.scaled = Norm(norm), scaled
        if not (isinstance(hardest, (int, float)) and 0 < hardest <= 1):
            raise ValueError(f"loss.hardest is a share in (0, 1]; got {hardest!r}.")
        self.balance, self.hardest = balance, hardest
        self.losses = nn.ModuleDict({name: term() for name, term in self.terms.items()})
        self.weights = used_weights(self.terms, weights, exact_terminal=exact_terminal)
        players, states = game.players, game.state_dim
        self.has_roles = len(set(game.roles)) > 1
        self.register_buffer("roles", torch.tensor(game.roles), persistent=False)
        sensors = game.sensors((game.type_box.lo + game.type_box.hi) / 2).shape[-1]
        inputs = 1 + players * states + self.has_roles
        self.net = median_of(members, lambda: DeepONet(inputs, sensors, activation, width, depth, activation_options))
        self.value_error = WeightedMeanAbsolutePercentageError()
        self.costate_error = WeightedMeanAbsolutePercentageError()
        self.register_buffer("running", torch.zeros(len(self.terms)))
        self.register_buffer("value_scale", torch.tensor(1.0))
        self.register_buffer("costate_scale", torch.ones(players, players, states))

    @property
    def streams(self) -> frozenset[str]:
        """Data streams that the weighted terms read."""
        return frozenset(term.stream for name, term in self.terms.items() if self.weights.get(name, 0) > 0)

    def compile_kernels(self) -> None:
        """Train through `torch.compile`, which pays in long runs."""
        for net in nets(self.net):
            net.kernels = compiled()

    def names(self) -> dict[str, str]:
        """Registered names of game, operator and activation."""
        parts = games.name_of(type(self.game)), operators.name_of(type(self)), self.options["activation"]
        return dict(zip(("game", "operator", "activation"), map(str, parts), strict=True))

    def term(self, name: str) -> LossTerm:
        """The loss term of that name."""
        term = self.losses[name]
        assert isinstance(term, LossTerm)
        return term

    def set_scales(self, scales: Scales) -> None:
        """Fix the sizes in which outputs and residuals are measured; they are saved with the weights."""
        self.value_scale.copy_(scales.value)
        self.costate_scale.copy_(scales.costate)

    def forward(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """V_i, (B,), (B, P, n), (B, P) -> (B, P)."""
        table = distinct_types(theta)
        raw = self.net(self._inputs(tau, x).flatten(0, -2), *self._branch(table)).view_as(theta) * self.value_scale
        if not self.exact_terminal:
            return raw
        return self.game.terminal_value(x) + (tau / self.game.horizon).unsqueeze(-1) * raw

    def field(self, points: Points, types: Types | None = None) -> Field:
        """Value, time derivative and every costate, of all players at once: medians over the members, entry by entry.

        With gradients enabled the result is differentiable in the parameters, but not in the points.

        Args:
            points: where, physical units.
            types: the points' theta as a table, which is searched for otherwise.
        """
        types = types or distinct_types(points.theta)
        first, *others = (self._field(net, points, types) for net in nets(self.net))
        if not others:
            return first
        return Field(*(torch.stack(parts).median(0).values for parts in zip(first, *others, strict=True)))

    def _field(self, net: DeepONet, points: Points, types: Types) -> Field:
        """The field of one member."""
        tau, x, theta = points
        inputs = self._inputs(tau, x).flatten(0, -2).detach()
        raw, gradient = net.value_gradient(inputs, *self._branch(types))
        value = raw.view_as(theta) * self.value_scale
        slope = gradient[:, 0].view_as(theta) * (2 / self.game.horizon) * self.value_scale
        views = gradient[:, 1 : 1 + x[0].numel()].reshape(*theta.shape, *x.shape[-2:])
        costate = ego_views(views, inverse=True) * (2 * self.value_scale / self.game.state_box.width)
        if not self.exact_terminal:
            return Field(value, slope, costate)
        share = (tau / self.game.horizon).unsqueeze(-1)
        slope = value / self.game.horizon + share * slope
        with torch.inference_mode(mode=False):
            end = self.game.terminal_value(x), terminal_costate(self.game, x.clone())
        return Field(end[0] + share * value, slope, end[1] + share[..., None, None] * costate)

    def _inputs(self, tau: Tensor, x: Tensor) -> Tensor:
        """Trunk inputs of every player, (B, P, inputs): scaled time, scaled states ego-first, and roles that differ."""
        views = ego_views(self.game.state_box.scale(x)).flatten(-2)
        times = (2 * tau / self.game.horizon - 1)[..., None, None].expand(*views.shape[:-1], 1)
        parts = [times, views]
        if self.has_roles:
            parts.append(self.roles.to(views).unsqueeze(-1).expand(*views.shape[:-1], 1))
        return torch.cat(parts, -1)

    def _branch(self, types: Types) -> tuple[Tensor, Tensor]:
        """Distinct branch inputs (C P, S), and which of them each row of the trunk takes, (B P,)."""
        players = self.game.players
        which = types.which.reshape(-1, 1) * players + torch.arange(players, device=types.which.device)
        return self.game.sensors(types.distinct).flatten(0, 1), which.flatten()

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Weighted sum of the norms of the terms whose stream is in the batch; the others are logged as NaN."""
        losses = self.loss_terms(batch)
        total = torch.stack([self.weights[name] * self._balanced(name, loss) for name, loss in losses.items()]).sum()
        absent = {f"loss/{name}": math.nan for stream in self.streams - batch.keys() for name in self._weighted(stream)}
        self.log_dict(absent | {f"loss/{name}": loss.detach() for name, loss in losses.items()})
        self.log("loss/total", total.detach(), prog_bar=True)
        return total

    def loss_terms(self, batch: Batch) -> dict[str, Tensor]:
        """Norm of each weighted term whose stream is in the batch, mean over the members, scalars by name."""
        samples = {name: self._selected(name, batch[name]) for name in sorted(self.streams & batch.keys())}
        sizes = [len(sample.points.tau) for sample in samples.values()]
        points = Points(*(torch.cat(parts) for parts in zip(*(s.points for s in samples.values()), strict=True)))
        types = tables([s.types or distinct_types(s.points.theta) for s in samples.values()])
        used = {
            name: self.term(name).stream
            for name in self.terms
            if self.term(name).stream in samples and self.weights.get(name, 0) > 0
        }
        norms: dict[str, list[Tensor]] = {name: [] for name in used}
        for net in nets(self.net):
            split = (part.split(sizes) for part in self._field(net, points, types))
            fields = dict(zip(samples, (Field(*parts) for parts in zip(*split, strict=True)), strict=True))
            for name, stream in used.items():
                norms[name].append(self.norm(self._residual(name, samples[stream], fields[stream])))
        return {name: torch.stack(each).mean() for name, each in norms.items()}

    def _residual(self, name: str, sample: Sample, field: Field) -> Tensor:
        """Residual of a term, in sizes of labels if `scaled`."""
        term = self.term(name)
        residual = term.residual(self.game, sample, field)
        if not self.scaled:
            return residual
        return residual / term.scale(self.game, sample, Scales(self.value_scale, self.costate_scale))

    def _selected(self, stream: str, sample: Sample) -> Sample:
        """The collocation points of the largest residuals, if only those count."""
        if stream != "interior" or self.hardest == 1:
            return sample
        with torch.no_grad():
            field = self.field(sample.points, sample.types)
            found = [self._residual(name, sample, field).abs().flatten(1).amax(-1) for name in self._weighted(stream)]
        worst = torch.stack(found).amax(0)
        return sample.rows(worst.topk(max(1, round(self.hardest * len(worst)))).indices)

    def _weighted(self, stream: str) -> list[str]:
        """Names of the terms that read a stream and have a weight."""
        return [name for name, term in self.terms.items() if term.stream == stream and self.weights.get(name, 0) > 0]

    def _balanced(self, name: str, loss: Tensor) -> Tensor:
        """A term, divided by its running mean if terms are balanced."""
        if not self.balance:
            return loss
        place = list(self.terms).index(name)
        before, now = self.running[place], loss.detach()
        self.running[place] = torch.where(before > 0, torch.lerp(now, before, 0.99), now)
        return loss / self.running[place].clamp_min(torch.finfo(loss.dtype).tiny)

    def validation_step(self, sample: Sample, batch_idx: int) -> None:
        """Weighted absolute percentage errors of values and costates on held-out labels."""
        if sample.labels is None:
            raise ValueError("Validation needs labelled rows; this sample has points only.")
        field = self.field(sample.points, sample.types)
        self.value_error(field.value, sample.labels.value)
        self.costate_error(field.costate.flatten(1), sample.labels.costate.flatten(1))
        self.log_dict({"val/value_error": self.value_error, "val/costate_error": self.costate_error})

    def spec(self) -> dict[str, Any]:
        """What `hno.training.checkpoint` needs to rebuild the operator, plain containers."""
        return {
            "format": SPEC_FORMAT,
            **self.names(),
            "constants": dict(self.game.constants),
            "fingerprint": self.game.fingerprint(),
            "options": self.options,
            "seen_types": self.seen_types,
            "config_hash": self.config_hash,
            "seed": self.seed,
        }

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the operator's `spec`."""
        checkpoint[SPEC_KEY] = self.spec()

    def configure_optimizers(self) -> Any:
        """What the `optimizer` argument builds."""
        if self.optimizer is None:
            raise ValueError("This operator was built without an optimizer; pass one to train it.")
        return self.optimizer(self.net.parameters())
