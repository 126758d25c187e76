"""What a search may choose from, in the words of Hydra's sweeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, RangeSweep
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from hno.cli.arguments import UsageError

FIXED = ("objective", "resume")
"""Keys that all trials of a study share."""


class Space(NamedTuple):
    """Axes of a search."""

    axes: dict[str, BaseDistribution]
    """By key; the choices of a categorical one are texts, as Hydra reads them."""
    keys: dict[str, str]
    """How Hydra takes each, with its plus signs."""
    fixed: list[str]
    """The words that all trials share."""

    def words(self, chosen: Mapping[str, Any]) -> list[str]:
        """The command line of a trial."""
        return [*self.fixed, *(f"{key}={chosen[name]}" for name, key in self.keys.items())]

    def corners(self) -> list[list[str]]:
        """Command lines of which some has every choice; numbers of a range are all alike here."""
        first = {name: _choices(axis)[0] for name, axis in self.axes.items()}
        others = [(name, choice) for name, axis in self.axes.items() for choice in _choices(axis)[1:]]
        return [self.words(first), *(self.words({**first, name: choice}) for name, choice in others)]


def space(words: Sequence[str]) -> Space:
    """The axes that a command line spans, and the words that are none.

    Args:
        words: as Hydra takes them.

    Raises:
        UsageError: an axis that makes no sense, or none at all.
    """
    found = Space({}, {}, [])
    last = {override.key_or_group: override for override in OverridesParser.create().parse_overrides([*words])}
    for override in last.values():
        if not override.is_sweep_override():
            found.fixed.append(str(override.input_line))
            continue
        name, key = override.key_or_group, override.get_key_element()
        if name.startswith("hydra") or name in FIXED:
            raise UsageError(f"{name} is the same for all trials; got {override.input_line}.")
        try:
            found.axes[name], found.keys[name] = _axis(override), key
        except ValueError as error:
            raise UsageError(f"{override.input_line} cannot be searched: {error}") from error
    if not found.axes:
        raise UsageError(
            "There is nothing to search. Give a key several values: 'optimizer.lr=tag(log,interval(1e-4,1e-2))', "
            "'network.width=range(32,129,32)' or operator=sno,hno."
        )
    return found


def _axis(override: Override) -> BaseDistribution:
    sweep: Any = override.value()
    if isinstance(sweep, ChoiceSweep):
        return CategoricalDistribution(list(override.sweep_string_iterator()))
    if not isinstance(sweep, (IntervalSweep, RangeSweep)):
        raise ValueError("name its choices, a,b")
    if unknown := sweep.tags - {"log"}:
        raise ValueError(f"the only tag is log, not {min(unknown)}")
    log, step = "log" in sweep.tags, None
    if isinstance(sweep, RangeSweep):
        values = sorted(sweep.range())
        if not values:
            raise ValueError("the range is empty")
        low, high, step = values[0], values[-1], abs(sweep.step)
    else:
        low, high = sweep.start, sweep.end
    if isinstance(low, int) and isinstance(high, int):
        return IntDistribution(low, high, log, int(step or 1))
    return FloatDistribution(low, high, log, step)


def _choices(axis: Any) -> Sequence[Any]:
    return axis.choices if isinstance(axis, CategoricalDistribution) else (axis.low,)


def said(axis: Any) -> str:
    """An axis in words."""
    if isinstance(axis, CategoricalDistribution):
        return ", ".join(map(str, axis.choices))
    step = "" if axis.step in (None, 1) else f" in steps of {axis.step:g}"
    return f"{axis.low:g} to {axis.high:g}{step}{', logarithmic' if axis.log else ''}"
