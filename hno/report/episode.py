"""An episode of episodes.json as a typed record, and what pictures and the player show of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict

from hno.games.scene import Road

BELIEVED = ("mean", "low", "high")
"""What is said of a belief."""
Array = Annotated[NDArray[np.float64], BeforeValidator(lambda value: np.asarray(value, dtype=np.float64))]


class Scene(BaseModel):
    """What is drawn around the players of a file of episodes, see `hno.games.scene`, and what they are called."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    bodies: list[tuple[float, float]] = []
    roads: list[Road] = []
    controls: list[str] = []
    players: list[str] = []
    note: str = ""


class Episode(BaseModel):
    """One closed-loop episode; F frames, P players, d dimensions."""

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False)

    theta: tuple[float, ...]
    kind: str = ""
    """ "worst" (most lost against the equilibrium), "typical" (of a median equilibrium) or "compared"."""
    start: str = ""
    """Equal for episodes from the same start state."""
    collided: bool = False
    clearance: float | None
    """Smallest value of -constraint."""
    cost: float | None = None
    label_cost: float | None = None
    t: Array
    """Time, s, (F,)."""
    positions: Array
    """m, (F, P, d)."""
    speed: Array | None = None
    """m/s, (F, P)."""
    controls: Array | None = None
    """(F, P, m)."""
    value: Array | None = None
    """V_i that the policy's value function gives to the rest of the episode, (F, P)."""
    radius: Array | None = None
    """Distance below which it is a collision, m, (F,); None where the constraint is no distance."""
    branch: Array | None = None
    """Branch of a potential that is played, (F,); None where there are none."""
    belief: Array | None = None
    """What the others believe of each player's type, where they learn: mean and ends of 90 %, (F, P, 3)."""
    other_side: bool = False
    """Whether two players pass each other on another side than along the equilibrium."""
    label_positions: Array | None = None
    """Positions along the equilibrium from the same start, m, (F, P, d)."""

    @property
    def lost(self) -> float | None:
        """Joint cost above the equilibrium's."""
        return None if self.cost is None or self.label_cost is None else self.cost - self.label_cost

    @property
    def order(self) -> tuple[bool, float, float]:
        """What episodes are ranked by, most lost first: collisions, then cost above the equilibrium's, then nearness.

        An episode without costs, or without a clearance, is not known to have lost anything.
        """
        return lost_most(self.__dict__)


def lost_most(content: Mapping[str, Any]) -> tuple[bool, float, float]:
    """What episodes are ranked by, from their entry of episodes.json, see `Episode.order`."""
    cost, best, near = (content.get(name) for name in ("cost", "label_cost", "clearance"))
    lost = math.inf if cost is None or best is None else best - cost
    return not content.get("collided"), lost, math.inf if near is None else near


def episode(content: Any) -> Episode:
    """An entry of episodes.json, up to its first frame that is not finite.

    Raises:
        ValueError: arrays are missing or do not fit.
    """
    found = Episode.model_validate(content)
    arrays = {name: value for name, value in found if isinstance(value, np.ndarray)}
    places = (*found.t.shape, *found.positions.shape[1:])
    shape_of = {"belief": (*places[:2], 3), "positions": places, "label_positions": places}
    shape_of |= {"speed": places[:2], "value": places[:2]}
    if found.controls is not None:
        shape_of["controls"] = (*places[:2], *found.controls.shape[2:3])
    wanted = {name: shape_of.get(name, places[:1]) for name in arrays}
    shapes = {name: array.shape for name, array in arrays.items()}
    if len(places) != 3 or places[2] not in (2, 3) or any(shape != wanted[name] for name, shape in shapes.items()):
        raise ValueError(f"arrays have shapes {shapes}, expected (F,) or (F, P, 2 or 3)")
    sound = np.isfinite(found.t) & np.isfinite(found.positions).all((1, 2))
    end = len(sound) if sound.all() else int(sound.argmin())
    if end == 0:
        raise ValueError("it has no finite frame")
    kept = {name: array[:end] for name, array in arrays.items()}
    return found.model_copy(update={name: one if np.isfinite(one).all() else None for name, one in kept.items()})


def distances(found: Episode) -> NDArray[np.float64] | None:
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
    """A row for every frame: frame, t (s), distance and radius (m, or None), branch (or None), lists over players.

    The lists are x, y and, in space, z; label_x and so on along the equilibrium, if that is known; where players learn,
    each one's type and what is believed of it: mean, low, high.
    """
    columns = {"t": found.t, "distance": distances(found), "radius": found.radius, "branch": found.branch}
    for prefix, path in (("", found.positions), ("label_", found.label_positions)):
        if path is not None:
            columns |= {f"{prefix}{axis}": path[..., i] for i, axis in enumerate("xyz"[: path.shape[2]])}
    if found.belief is not None:
        columns |= {name: found.belief[..., k] for k, name in enumerate(BELIEVED)}
        columns["type"] = np.broadcast_to(found.theta, found.belief.shape[:2])
    lists = [[None] * len(found.t) if one is None else one.round(3).tolist() for one in columns.values()]
    return [{"frame": k, **dict(zip(columns, row, strict=True))} for k, row in enumerate(zip(*lists, strict=True))]


def columns(found: Episode) -> dict[str, Any]:
    """What the page plays, by name: t (F,), then by frame; None for what does not exist.

    p and ghost are positions, of the episode and of the equilibrium; u controls, v speeds, value, distance, radius and
    branch; mean, low and high what is believed of each player's type.
    """
    arrays = {"t": found.t, "p": found.positions, "ghost": found.label_positions, "u": found.controls}
    arrays |= {"v": found.speed, "value": found.value, "distance": distances(found), "radius": found.radius}
    arrays |= {name: None if found.belief is None else found.belief[..., k] for k, name in enumerate(BELIEVED)}
    some = {name: None if one is None else one.round(3).tolist() for name, one in arrays.items()}
    return some | {"branch": None if found.branch is None else found.branch.astype(int).tolist()}


def whole(found: Episode, up: int) -> dict[str, float]:
    """Signals of `encounter`: everything that happens, with room for discs; `up` is the second axis, 1 or 2."""
    paths = [path for path in (found.positions, found.label_positions) if path is not None]
    places = np.concatenate(paths)[:, :, [0, up]]
    room = 0.7 * (1.0 if found.radius is None else found.radius.max())
    (left, bottom), (right, top) = (places.min((0, 1)) - room).tolist(), (places.max((0, 1)) + room).tolist()
    return {"left": left, "right": right, "bottom": bottom, "top": top}
