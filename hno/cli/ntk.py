"""The section `ntk` of an evaluation: spectra of the tangent kernel at every training type."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from omegaconf import DictConfig
from rich.table import Table

from hno.cli.checks import whole_number
from hno.data.rows import NoLabelsError
from hno.evaluation.ntk import rows_per_point, type_kernel
from hno.evaluation.spectrum import Summary, summary
from hno.operators import ValueOperator
from hno.training.checkpoint import LearnedPolicy
from hno.types import Extremal

COLUMNS = ("theta", "points", "kernel", "condition", "rank", "effective rank", "largest eigenvalue")
KINDS = {"kernel": "J J'", "product": "paper's product"}
"""What a section has of each type, and how it is called."""


def check_ntk(policy: LearnedPolicy, types: Iterable[tuple[float, ...]], settings: DictConfig) -> None:
    """Raise ValueError for entries from which no kernel can be made."""
    check_rows(policy.operator, settings)
    if not set(types) & set(policy.types):
        seen = "; ".join(",".join(f"{t:g}" for t in theta) for theta in policy.types) or "none"
        raise ValueError(f'ntk=true needs a type of the training run among theta; these are "{seen}".')


def check_rows(operator: ValueOperator, settings: DictConfig) -> None:
    """Raise ValueError unless the operator is one net and its kernel has rows for at least one point."""
    members = len(operator.members)
    if members > 1:
        raise ValueError(f"ntk=true is for one net, this operator has {members}. Train it with operator.members=1.")
    whole_number("ntk_rows", settings.ntk_rows, rows_per_point(operator), "the rows of one point")


def ntk_section(policy: LearnedPolicy, labels: Sequence[Extremal], settings: DictConfig) -> list[dict[str, Any]]:
    """One entry for every set of labels whose type the operator was trained on."""
    seen = [found for found in labels if tuple(found.theta[0].tolist()) in policy.types]
    return [_entry(policy.operator, found, settings) for found in seen]


def _entry(operator: ValueOperator, found: Extremal, settings: DictConfig) -> dict[str, Any]:
    theta = found.theta[0].tolist()
    try:
        kernel = type_kernel(operator, found, settings.ntk_rows, settings.seed)
    except NoLabelsError as error:
        return {"theta": theta, "reason": str(error), "points": 0, "block": None, **dict.fromkeys(KINDS)}
    spectra = {"kernel": summary(kernel.kernel), "product": summary(kernel.product)}
    return {"theta": theta, "reason": None, "points": kernel.points, "block": kernel.block, **spectra}


def ntk_table(section: Sequence[Mapping[str, Any]]) -> Table:
    """Condition numbers and ranks of a section."""
    caption = (
        "rank: eigenvalues above rows * 2.2e-16 of the largest, the others are rounding; condition: largest over "
        "smallest eigenvalue; effective rank: exp of the eigenvalues' entropy; product: of trunk's and branch's kernel"
    )
    table = Table(*COLUMNS, title="Neural tangent kernel", caption=caption)
    for entry in section:
        theta = ", ".join(f"{t:g}" for t in entry["theta"])
        for kind, name in KINDS.items():
            table.add_row(theta, str(entry["points"]), name, *_cells(entry[kind]))
    return table


def _cells(found: Summary | None) -> list[str]:
    if found is None or found["condition"] is None:
        return ["n/a"] * 4
    whole = found["rank"] == found["rows"]
    return [
        f"{found['condition']:.2e}" if whole else f"> {1 / found['cutoff']:.2e}",
        f"{found['rank']} of {found['rows']}",
        f"{found['effective_rank']:.1f}",
        f"{found['curve'][0][1]:.2e}",
    ]
