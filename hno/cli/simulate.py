"""`hno simulate`: exported controllers play against each other, or against a person, in a browser window or without."""

from __future__ import annotations

import math
import os
import sys
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, final

import torch
from pydantic import ConfigDict, Field, NonNegativeInt
from torch import Tensor

from hno.cli.arguments import Arguments, UsageError
from hno.cli.schema import Settings, validated
from hno.cli.window import Over, Speed, Window
from hno.control.exported import ExportedPolicy, load_exported
from hno.control.policy import Policy
from hno.control.rollout import control_steps, rollout
from hno.games import Game
from hno.games.kinematics import separation
from hno.runtime import ArtefactError
from hno.types import Points, Trajectory

TRIES = 1000
"""Start states that are drawn before the start box is taken to hold no safe one."""


class SimulateSettings(Settings):
    """What key=value sets."""

    model_config = ConfigDict(strict=False)

    theta: str = ""
    """One type for each player; the middle of their box by default."""
    drive: NonNegativeInt = 0
    """The player that a person drives, 0 for nobody."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Of the start state."""
    speed: Speed = 0.5
    port: Annotated[int, Field(ge=0, lt=2**16)] = 0
    """Of the page, 0 for any."""
    dt: float = 0.02
    """Time that a control is held, s."""


class Lost(Exception):  # noqa: N818  # no error of the program
    """An episode cannot go on."""


class Chosen(NamedTuple):
    """What is played."""

    policies: Sequence[ExportedPolicy]
    """One for each player, (P,)."""
    theta: tuple[float, ...]
    seed: int
    dt: float

    @property
    def game(self) -> Game:
        """Their game."""
        return self.policies[0].game

    def start(self) -> Tensor:
        """A random state of the start box that violates nothing, (1, P, n).

        Raises:
            ValueError: there seems to be none.
        """
        generator = torch.Generator().manual_seed(self.seed)
        drawn = self.game.initial_box.sample(TRIES, generator)
        safe = ~self.game.violates(drawn, torch.tensor(self.theta).expand(TRIES, -1))
        if not bool(safe.any()):
            raise ValueError(f"None of {TRIES} random starts is safe for the types {self.theta}: choose other types.")
        return drawn[safe][:1]


@final
class Match(Policy):
    """Every player plays its own part of what its own controller answers; a window shows it, and a person may drive.

    Args:
        chosen: what is played.
        window: where.
    """

    def __init__(self, chosen: Chosen, window: Window | None = None) -> None:
        self.chosen, self.window = chosen, window

    def act(self, tau: Tensor, x: Tensor, theta: Tensor) -> Tensor:
        """Controls, (B, P, m).

        Raises:
            Over: the window asks for another episode.
            Lost: there are no finite controls to show.
        """
        policies = self.chosen.policies
        answers = {policy: policy.answers(Points(tau, x, theta)) for policy in dict.fromkeys(policies)}
        u = torch.stack([answers[policy]["control"][:, i] for i, policy in enumerate(policies)], 1)
        if self.window is None:
            return u
        values = [answers[policy][_values(policy)][0, i] for i, policy in enumerate(policies)]
        driven = self.window.asked.player
        if driven:
            u[:, driven - 1] = steered(self.chosen.game, driven - 1, self.window.asked.drive)
        self.window.tell(moment(self.chosen.game, float(tau), x[0], theta[0], u[0], torch.stack(values)))
        if not bool(u.isfinite().all()):
            raise Lost("no controller has a finite answer here, too far outside the PDE box")
        self.window.pace(self.chosen.dt)
        return u


def _values(policy: ExportedPolicy) -> str:
    return "players" if policy.operator.potential else "value"


def steered(game: Game, player: int, drive: Sequence[float]) -> Tensor:
    """Controls of a person inside the control box, (m,): from -1, the low end, to 1, the high end.

    Without a key it is 0, or the middle of a control that is never 0.
    """
    lo, hi = (end.expand(game.players, -1)[player] for end in (game.control_box.lo, game.control_box.hi))
    rest = torch.where((lo <= 0) & (hi >= 0), 0.0, (lo + hi) / 2)
    share = torch.tensor(drive or [0.0]).to(lo).clamp(-1, 1)
    return torch.where(share > 0, torch.lerp(rest, hi, share), torch.lerp(rest, lo, -share)).clamp(lo, hi)


def moment(game: Game, tau: float, x: Tensor, theta: Tensor, u: Tensor, values: Tensor) -> dict[str, Any]:
    """What the window shows of one time, of states (P, n) and types (P,): JSON content, null for what is not finite."""
    places = game.positions(x)
    apart = separation(places).amin() if game.players > 1 else None
    radius = game.constraint(x, theta).amax() + apart if apart is not None and game.distance_constraints else None
    return {
        "t": round(game.horizon - tau, 6), "places": plain(places), "distance": plain(apart), "radius": plain(radius),
        "controls": plain(u), "values": plain(values), "inside": bool(game.state_box.contains(x)),
        "violated": bool(game.violates(x, theta)),
    }  # fmt: skip


def plain(numbers: Tensor | None) -> Any:
    """Nested lists of numbers with four decimals; None for what is missing or not finite."""
    if numbers is None:
        return None
    if numbers.dim():
        return [plain(part) for part in numbers]
    return round(float(numbers), 4) if math.isfinite(numbers) else None


def outcome(chosen: Chosen, played: Trajectory) -> str:
    """One line about an episode."""
    clearance, unit = float(played.clearance), chosen.game.constraint_unit
    near = f"closest {float(played.distance):.3f} m, " if chosen.game.players > 1 else ""
    values = ", ".join(f"{value:.4g}" for value in played.value[0].tolist())
    verdict = "COLLISION" if bool(played.collided) else "no collision"
    return f"{said(chosen)}: {verdict}; {near}clearance {clearance:.3f} {unit}; values {values}"


def said(chosen: Chosen) -> str:
    """What is played, in words."""
    return (
        f"{chosen.policies[0].names()['game']}, types {', '.join(f'{t:g}' for t in chosen.theta)}, seed {chosen.seed}"
    )


def run(given: Arguments) -> int:
    """`hno simulate ARTEFACT [ARTEFACT ...] [key=value ...] [--no-window]`."""
    shown = "--no-window" not in given.flags
    try:
        paths, settings = read(given)
        chosen = choose(paths, settings)
        if settings.drive > (chosen.game.players if shown else 0):
            raise UsageError(
                f"drive={settings.drive} names no player who can be driven here: without a window, nobody."
            )
    except ArtefactError as error:
        raise OSError(str(error)) from error
    if not shown:
        print(outcome(chosen, rollout(chosen.game, Match(chosen), chosen.start(), [chosen.theta], dt=chosen.dt)))
        return 0
    with Window(settings.port, about(chosen.game, paths), settings.drive, settings.speed) as window:
        print(f"{window.address} (Ctrl-C ends)", flush=True)
        if sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
            webbrowser.open(window.address)
        while True:
            play(chosen, window)
            chosen = chosen._replace(seed=chosen.seed + 1)


def read(given: Arguments) -> tuple[list[str], SimulateSettings]:
    """Paths of artefacts, and settings.

    Raises:
        UsageError: a key is unknown, a value makes no sense, or there is no artefact.
    """
    paths = [*given.words, *(entry for entry in given.overrides if Path(entry).exists())]
    words = dict(entry.partition("=")[::2] for entry in given.overrides if entry not in paths)
    if not paths:
        raise UsageError("Name one exported controller, or one for each player; `hno export` writes them.")
    try:
        return paths, validated(SimulateSettings, words)
    except ValueError as error:
        raise UsageError(str(error)) from error


def choose(paths: Sequence[str], settings: SimulateSettings) -> Chosen:
    """The controllers and how they are to play.

    Raises:
        ArtefactError: one is damaged, of another version of its game, or cannot run here.
        UsageError: there are not as many as players, or of different games, or types or dt make no sense.
    """
    opened = [load_exported(path) for path in paths]
    game = opened[0].game
    if len(opened) not in (1, game.players):
        raise UsageError(f"Name one controller for all {game.players} players, or one for each; got {len(opened)}.")
    for path, other in zip(paths, opened, strict=True):
        if other.about["fingerprint"] != opened[0].about["fingerprint"]:
            games = f"{opened[0].about['game']!r} and {other.about['game']!r}"
            raise UsageError(f"{paths[0]} and {path} are of different games, or of other constants: {games}.")
    middle = ((game.type_box.lo + game.type_box.hi) / 2).tolist()
    types: Any = settings.theta.split(",") if settings.theta else middle
    try:
        control_steps(game, settings.dt)
        (theta,) = game.validate_types([types])
    except ValueError as error:
        raise UsageError(str(error)) from error
    return Chosen(opened * (game.players // len(opened)), theta, settings.seed, settings.dt)


def play(chosen: Chosen, window: Window) -> None:
    """One episode in a window, until another one is asked for."""
    window.begin(said(chosen))
    try:
        played = rollout(chosen.game, Match(chosen, window), chosen.start(), [chosen.theta], dt=chosen.dt)
        window.tell({"end": outcome(chosen, played), "bad": bool(played.collided)})
        window.wait()
    except Lost as lost:
        window.tell({"end": f"{said(chosen)}: {lost}", "bad": True})
        window.wait()
    except Over:
        pass


def about(game: Game, paths: Sequence[str]) -> dict[str, Any]:
    """What the page knows of all episodes."""
    box = torch.stack([end.expand(game.players, -1) for end in (game.control_box.lo, game.control_box.hi)])
    return {
        "players": game.players, "horizon": game.horizon, "controls": plain(box), "artefacts": list(paths),
        "discs": game.distance_constraints,
    }  # fmt: skip
