"""Spectra of positive semidefinite matrices: ranks, condition numbers and their ratios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

Summary = Mapping[str, Any]
"""A spectrum in plain containers, see `summary`."""
CURVE = 40
"""Eigenvalues of a summary, at most."""


class Spectrum(NamedTuple):
    """Eigenvalues of a matrix, and what they say about it."""

    eigenvalues: Tensor
    """From the largest, float64, (N,). Those that should be 0 are as large as rounding makes them, of either sign."""
    cutoff: float
    """Share of the largest eigenvalue up to which an eigenvalue counts as 0."""
    rank: int
    """Number of eigenvalues above the cut-off."""
    condition: float | None
    """Largest eigenvalue over the smallest above the cut-off; None for a matrix of zeros.

    Where `rank` is less than N, the matrix's own is more than 1 / `cutoff`, and nothing else is known of it.
    """
    effective_rank: float | None
    """exp of the entropy of the eigenvalues as shares of their sum (Roy & Vetterli 2007); None for zeros."""


class Ratio(NamedTuple):
    """A ratio of condition numbers, or what is known of it; None where both are cut off, or a matrix is of zeros."""

    value: float | None
    bound: str
    """"=" for the ratio itself, ">" or "<" where it is more or less than `value`, "n/a" without one."""


def spectrum(matrix: Tensor, cutoff: float | None = None) -> Spectrum:
    """The spectrum of a symmetric positive semidefinite matrix.

    Args:
        matrix: (N, N), float64.
        cutoff: see `Spectrum`; by default N times the machine epsilon, up to which an eigenvalue may be rounding.

    Raises:
        ValueError: an entry is not finite.
    """
    if not bool(matrix.isfinite().all()):
        raise ValueError("A matrix with entries that are not finite has no spectrum; have the weights diverged?")
    values = torch.linalg.eigvalsh(matrix).flip(0)
    cutoff = len(values) * torch.finfo(values.dtype).eps if cutoff is None else cutoff
    kept = values[(values > 0) & (values > cutoff * values[0])]
    if len(kept) == 0:
        return Spectrum(values, cutoff, 0, None, None)
    positive = values.clamp_min(0)
    entropy = torch.special.entr(positive / positive.sum()).sum()
    return Spectrum(values, cutoff, len(kept), float(kept[0] / kept[-1]), float(entropy.exp()))


def summary(found: Spectrum) -> dict[str, Any]:
    """Plain containers, with the eigenvalues above the cut-off at evenly spaced logarithms of their number.

    Returns:
        "rows" N; "cutoff", "rank", "condition" and "effective_rank" as in `Spectrum`; "curve", a list of
        [number of the eigenvalue, from 1; eigenvalue].
    """
    numbers = torch.logspace(0, torch.tensor(max(found.rank, 1)).log10().item(), CURVE).round().long().unique()
    curve = [[number, float(found.eigenvalues[number - 1])] for number in numbers.tolist() if number <= found.rank]
    plain = {name: value for name, value in found._asdict().items() if name != "eigenvalues"}
    return {"rows": len(found.eigenvalues), **plain, "curve": curve}


def condition_ratio(over: Summary | None, under: Summary | None) -> Ratio:
    """Condition number of one matrix over that of another; a bound where one of them is cut off."""
    if over is None or under is None or not (over["rank"] and under["rank"]):
        return Ratio(None, "n/a")
    cut = [one["rank"] < one["rows"] for one in (over, under)]
    if all(cut):
        return Ratio(None, "n/a")
    large, small = (
        1 / one["cutoff"] if is_cut else one["condition"] for one, is_cut in zip((over, under), cut, strict=True)
    )
    return Ratio(large / small, ">" if cut[0] else "<" if cut[1] else "=")


def condition_ratios(results: Mapping[str, Sequence[Mapping[str, Any]]], over: str = "tanh") -> list[dict[str, Any]]:
    """Ratios of condition numbers per player type (the paper's table of activations: tanh / sin and tanh / relu).

    Args:
        results: sections "ntk" of results.json, by activation or any other name.
        over: the name whose condition numbers are divided by those of the others.

    Returns:
        One entry for every type that all sections have: "theta", and for "kernel" and for "product" a `Ratio` by name.

    Raises:
        ValueError: no section of that name or no other one, no common type, or kernels of different points.
    """
    if over not in results or len(results) < 2:
        raise ValueError(f"Ratios need a section {over!r} and at least one other; got {', '.join(results) or 'none'}.")
    sections = {
        name: {tuple(entry["theta"]): entry for entry in section if entry["kernel"] is not None}
        for name, section in results.items()
    }
    common = [theta for theta in sections[over] if all(theta in section for section in sections.values())]
    if not common:
        raise ValueError(f"The sections {', '.join(results)} have no player type in common: evaluate the same types.")
    found = list[dict[str, Any]]()
    for theta in common:
        entries = {name: section[theta] for name, section in sections.items()}
        points = {name: entry["points"] for name, entry in entries.items()}
        if len(set(points.values())) > 1:
            raise ValueError(f"Kernels of different numbers of points do not compare; at theta = {theta}: {points}.")
        first = entries.pop(over)
        ratios = {
            kind: {name: condition_ratio(first[kind], other[kind]) for name, other in entries.items()}
            for kind in ("kernel", "product")
        }
        found.append({"theta": list(theta), **ratios})
    return found
