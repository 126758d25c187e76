"""A picture of one episode: where the players go, and how far they stay apart."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from hno.games import Game
from hno.games.kinematics import separation
from hno.types import Trajectory


class PlotsMissingError(RuntimeError):
    """The optional package for pictures is not installed."""


def rollout_picture(game: Game, played: Trajectory, theta: Tensor, path: Path, title: str, row: int = 0) -> None:
    """Draw the paths of one episode and the distances over time.

    Args:
        game: the game.
        played: episodes.
        theta: their player types, (B, P).
        path: file to write; its suffix chooses the format.
        title: a line above the picture.
        row: which episode.

    Raises:
        PlotsMissingError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise PlotsMissingError("Pictures need matplotlib: pip install 'hno[plots]'.") from error
    x, t = played.x[row], played.t
    places = game.positions(x)
    distance = separation(places).amin(-1)
    worst = game.constraint(x, theta[row].expand(len(t), -1)).amax((-2, -1))
    allowed, round_players = worst + distance, game.distance_constraints and game.players > 1
    figure = Figure(figsize=(9, 5), layout="constrained")
    top, bottom = figure.subplots(2, 1, height_ratios=(3, 2))
    closest = int(distance.argmin())
    for player in range(game.players):
        path_of = places[:, player]
        (line,) = top.plot(path_of[:, 0], path_of[:, 1], label=f"player {player + 1}, type {theta[row, player]:g}")
        top.scatter(path_of[::10, 0], path_of[::10, 1], s=12, color=line.get_color())
        top.scatter(*path_of[0, :2], marker="s", color=line.get_color())
        if round_players:
            top.add_patch(_disc(path_of[closest], float(allowed[closest]) / 2, line.get_color()))
    top.set(xlabel="x [m]", ylabel="y [m]", title=title)
    top.legend(loc="best", frameon=False)
    if round_players:
        bottom.plot(t, distance, color="black", label="distance between players")
        bottom.plot(t, allowed, color="crimson", linestyle="--", label="collision radius")
        bottom.set(ylabel="[m]", ylim=(0, min(float(distance.max()), 6 * float(allowed.max()))))
    else:
        bottom.plot(t, -worst, color="black", label="clearance")
        bottom.set(ylabel=f"[{game.constraint_unit}]")
    bottom.set(xlabel="t [s]")
    bottom.legend(loc="best", frameon=False)
    figure.savefig(path, dpi=110)


def _disc(centre: Tensor, radius: float, color: str) -> object:
    from matplotlib.patches import Circle

    return Circle((float(centre[0]), float(centre[1])), radius, alpha=0.25, color=color)


def typical(played: Trajectory) -> int:
    """The episode with the median smallest distance."""
    return int(torch.argsort(played.distance)[len(played.distance) // 2])
