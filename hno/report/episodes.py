"""What pictures and the player show of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hno.report.episode import Array, Episode
from hno.report.records import Run
from hno.report.tables import names_of
from hno.report.verdicts import at, clearance

MOST = 400
"""Episodes of a page, at most."""


def distances(found: Episode) -> Array | None:
    """Distance between the closest players, m, (F,); None for one player."""
    players = found.positions.shape[1]
    if players == 1:
        return None
    apart = np.linalg.norm(found.positions[:, :, None] - found.positions[:, None], axis=-1)
    apart[:, range(players), range(players)] = np.inf
    return apart.min((1, 2))


def closest(found: Episode) -> int:
    """The frame of the smallest distance above the collision radius; the last one of a single player."""
    apart = distances(found)
    if apart is None:
        return len(found.t) - 1
    return int((apart - (0 if found.radius is None else found.radius)).argmin())


def frames(found: Episode) -> list[dict[str, Any]]:
    """A row for every frame: frame, t (s), distance and radius (m, or None), and lists over players.

    The lists are x, y and, in space, z; label_x and so on along the equilibrium, if that is known.
    """
    apart = distances(found)
    paths = {"": found.positions, "label_": found.label_positions}
    return [
        {
            "frame": k,
            "t": round(float(t), 3),
            "distance": None if apart is None else round(float(apart[k]), 3),
            "radius": None if found.radius is None else round(float(found.radius[k]), 3),
            **{
                f"{prefix}{axis}": [round(float(place), 2) for place in path[k, :, i]]
                for prefix, path in paths.items()
                if path is not None
                for i, axis in enumerate("xyz"[: path.shape[2]])
            },
        }
        for k, t in enumerate(found.t)
    ]


def whole(found: Episode, up: int) -> dict[str, float]:
    """Signals of `episode_charts.encounter`: everything that happens, with room for discs.

    Args:
        found: the episode.
        up: the second axis of the view, 1 or 2.
    """
    paths = [path for path in (found.positions, found.label_positions) if path is not None]
    places = np.concatenate(paths)[:, :, [0, up]]
    room = 0.7 * (1.0 if found.radius is None else float(found.radius.max()))
    (left, bottom), (right, top) = places.min((0, 1)) - room, places.max((0, 1)) + room
    sides = {"left": left, "right": right, "bottom": bottom, "top": top}
    return {side: round(float(value), 2) for side, value in sides.items()}


def reach(found: Episode) -> float:
    """Largest distance worth showing, m: six collision radii, unless players never come so far apart."""
    apart = distances(found)
    far = 1.0 if apart is None else float(apart.max())
    return far if found.radius is None else min(far, 6 * float(found.radius.max()))


def described(run: Run, found: Episode) -> str:
    """An episode in a sentence."""
    apart = distances(found)
    between = ""
    if found.collided and found.radius is not None and apart is not None and bool((apart >= found.radius).all()):
        between = " (between the frames shown)"
    cost, label = ("n/a" if value is None else f"{value:.1f}" for value in (found.cost, found.label_cost))
    near = clearance(found, run.constraint_unit)
    costs = f"Joint cost {cost}, the equilibrium's {label}."
    return f"{run.name}, types {at(found.theta)}, {found.kind}: {near}{between}. {costs}"


def ranked(runs: Sequence[Run]) -> list[tuple[Run, Episode]]:
    """Every episode: the worst of every run first, then a typical one of every run, then by clearance."""
    ordered = []
    for run in runs:
        own = sorted(run.episodes, key=by_clearance)
        first = [next((e for e in own if e.kind == kind), None) for kind in ("worst", "typical")]
        ordered += [(next((k for k, e in enumerate(first) if e is one), 2), by_clearance(one), run, one) for one in own]
    return [(run, one) for *_, run, one in sorted(ordered, key=lambda entry: entry[:2])]


def by_clearance(found: Episode) -> float:
    """What episodes are ranked by; without a clearance they come last."""
    return np.inf if found.clearance is None else found.clearance


def playable(run: Run, found: Episode) -> dict[str, Any]:
    """What the page's player gets of an episode."""
    views = {"top": 1, "side": 2} if found.positions.shape[2] == 3 else {"top": 1}
    collision = " · collision" if found.collided else ""
    return {
        **names_of(run, "any"), "title": f"{run.name} · {at(found.theta)} · {found.kind}{collision}",
        "said": described(run, found), "collided": found.collided, "closest": closest(found),
        "reach": round(reach(found), 2), "frames": frames(found),
        "whole": {view: whole(found, up) for view, up in views.items()},
    }  # fmt: skip
