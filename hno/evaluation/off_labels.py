"""How far value and gradient are from equilibria where nothing was labelled, by region and time to go."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from hno.data.sources import Known, make_sampler, sample_points
from hno.evaluation import format as text
from hno.evaluation.sections import Column, Evaluation, ModelSection, sections
from hno.games import Game
from hno.games.base import own_costate
from hno.operators import ValueOperator
from hno.types import Extremal, Points, PotentialField, Status

SHARES = (1.0, 2 / 3, 1 / 3)
"""Parts of the horizon that are left in the PDE box and near the constraint."""


def regions(game: Game, types: Tensor, seed: int) -> Iterator[tuple[str, float, Tensor]]:
    """Regions, time to go in s, and states with the types (B, P), (B, P, n): the same for the same seed.

    The start box and one that is twice as wide with the whole game to go; the PDE box and the surface constraint = 0
    with parts of it to go.
    """

    def generator() -> torch.Generator:
        return torch.Generator().manual_seed(seed)

    for name, widen in (("start box", 1.0), ("start box, twice as wide", 2.0)):
        yield name, game.horizon, game.initial_box.widened(widen).sample(len(types), generator())
    for name, source in (("PDE box", "box"), ("near the constraint", "band")):
        sampler = make_sampler({source: 1.0})
        x = sample_points(game, types, sampler, Known(None, None), 1.0, generator()).x
        for share in SHARES:
            yield name, share * game.horizon, x


@torch.no_grad()
def errors(operator: ValueOperator, found: Extremal, tau: float) -> dict[str, Any]:
    """Errors at the first node of equilibria; None where none was found."""
    known = found.status == Status.CONVERGED
    like = operator.value_scale
    x, theta = found.x[known, 0].to(like), found.theta[known].to(like)
    entries: dict[str, Any] = {"points": len(known), "solved": int(known.sum())}
    names = ("safe", "value_error", "value", "relative_value", "relative_gradient")
    if not entries["solved"]:
        return entries | dict.fromkeys(names)
    field = operator.field(Points(x.new_full((len(x),), tau), x, theta))
    value = field.players if isinstance(field, PotentialField) else field.value
    own = field.costate.squeeze(-3) if isinstance(field, PotentialField) else own_costate(field.costate)
    true, slope = found.value[known, 0].to(like), own_costate(found.costate[known, 0]).to(like)
    scale = operator.game.state_box.width / 2  # gradients in half widths of the box, so that units do not matter
    off, size = ((part * scale).flatten(1).norm(dim=-1).mean() for part in (own - slope, slope))
    numbers = (
        (found.clearance[known] > 0).double().mean(), (value - true).abs().median(), true.abs().median(),
        (value - true).abs().mean() / true.abs().mean(), off / size,
    )  # fmt: skip
    return entries | {name: float(number) for name, number in zip(names, numbers, strict=True)}


@sections.register("off_labels")
class OffLabels(ModelSection):
    """Errors of value and gradient by region and time to go, against equilibria that are solved for it."""

    heading = "Errors off the labels"
    note = (
        "against equilibria from these states; relative: mean error over mean size; gradient: of V_i, or W, in the own "
        "states, measured in half widths of the PDE box"
    )
    columns = (
        Column("region", "region"),
        Column("tau", "time to go", "s", text.significant),
        Column("solved", "equilibria", format=text.whole),
        Column("safe", "safe ones", format=text.percent),
        Column("value_error", "median value error", format=text.significant),
        Column("value", "median |value|", format=text.significant),
        Column("relative_value", "relative value error", format=text.percent),
        Column("relative_gradient", "relative gradient error", format=text.percent),
    )

    def compute(self, evaluation: Evaluation) -> list[dict[str, Any]]:
        """One line per region and time to go; the types that are evaluated take turns."""
        count, game = evaluation.options["off_labels"], evaluation.game
        like = game.state_box.lo
        table = torch.tensor(evaluation.types, dtype=like.dtype, device=like.device)
        types = table[torch.arange(count) % len(table)]
        rows = []
        for region, tau, x in regions(game, types, evaluation.options["seed"]):
            found = evaluation.equilibria(game, x.double(), types.double(), tau)
            rows.append({"region": region, "tau": tau, **errors(evaluation.policy.operator, found, tau)})
        return rows

    def rows(self, content: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
        """One line per region and time to go."""
        return content
