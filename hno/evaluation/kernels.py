"""The section `ntk` of an evaluation: spectra of the tangent kernel at every type of the training run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hno.data.rows import NoLabelsError
from hno.evaluation import format as text
from hno.evaluation.ntk import rows_per_point, type_kernel
from hno.evaluation.sections import Column, Evaluation, ModelSection, sections
from hno.evaluation.spectrum import summary
from hno.operators import ValueOperator
from hno.types import Extremal

KINDS = {"kernel": "J J'", "product": "paper's product"}
"""What a section has of each type, and how it is called."""


def check_rows(operator: ValueOperator, rows: object) -> None:
    """Refuse an operator of several nets, and fewer rows than one point has.

    Raises:
        ValueError: either of these.
    """
    members, least = len(operator.members), rows_per_point(operator)
    if members > 1:
        raise ValueError(f"ntk=true is for one net, this operator has {members}. Train it with operator.members=1.")
    if not (type(rows) is int and rows >= least):
        raise ValueError(f"ntk_rows must be a whole number of at least {least}, the rows of one point; got {rows!r}.")


def type_entry(operator: ValueOperator, found: Extremal, rows: int, seed: int) -> dict[str, Any]:
    """JSON content of the kernel at one type; a product is None where a network has no trunk and branch."""
    theta = found.theta[0].tolist()
    try:
        kernel = type_kernel(operator, found, rows, seed)
    except NoLabelsError as error:
        return {"theta": theta, "reason": str(error), "points": 0, "block": None, **dict.fromkeys(KINDS)}
    product = None if kernel.product is None else summary(kernel.product)
    counts = {"theta": theta, "reason": None, "points": kernel.points, "block": kernel.block}
    return {**counts, "kernel": summary(kernel.kernel), "product": product}


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
