"""What pictures draw around players. No number of a game depends on it."""

from __future__ import annotations

from typing import NamedTuple

CAR = (4.5, 1.8)
"""Length and width of a car as it is drawn, m."""
CAR_CONTROLS = ("turn rate [rad/s]", "acceleration [m/s²]")


class Road(NamedTuple):
    """A straight road along one axis of the common frame."""

    axis: int
    """0: along x; 1: along y."""
    edges: tuple[float, float]
    """Where it ends across, m."""
    marks: tuple[float, ...] = ()
    """Lines between its lanes, m."""


class Scene(NamedTuple):
    """Bodies, roads and names; by default players are points in empty space and columns are numbered."""

    bodies: tuple[tuple[float, float], ...] = ()
    """Length and width of each player, m, seen from above and ahead along its path; empty for points."""
    roads: tuple[Road, ...] = ()
    controls: tuple[str, ...] = ()
    """Name and unit of each control."""
    players: tuple[str, ...] = ()
    """What each player is called."""
    note: str = ""
    """What is drawn that the game does not know."""

    def named(self, kind: str, count: int) -> tuple[str, ...]:
        """Names of "controls" or "players"; numbered where the scene has others than `count` of them."""
        own: tuple[str, ...] = getattr(self, kind)
        return own if len(own) == count else tuple(f"{kind.removesuffix('s')} {k + 1}" for k in range(count))
