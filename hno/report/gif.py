"""An episode as an animated picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hno.report.picture import PlotsMissingError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

VIEWS = {2: ((0, 1),), 3: ((0, 1), (0, 2))}
"""Pairs of coordinates to look at: from above, and for games in space from the side too."""


def animate(episode: Mapping[str, Any], path: Path, title: str, speed: float = 1.0) -> None:
    """Write one episode of episodes.json as a GIF: paths so far, and discs that overlap where the players collide.

    Args:
        episode: an entry of `episodes`, with `t` (F), `positions` (F, P, d), `radius` (F), m and s.
        path: file to write.
        title: a line above the picture.
        speed: seconds of the episode per second of the animation.

    Raises:
        PlotsMissingError: matplotlib is not installed.
    """
    try:
        from matplotlib.animation import FuncAnimation, PillowWriter
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise PlotsMissingError("Pictures need matplotlib: pip install 'hno[plots]'.") from error
    places, times, radii = episode["positions"], episode["t"], episode["radius"]
    views = VIEWS[len(places[0][0])]
    figure = Figure(figsize=(6, 1 + 2.5 * len(views)), layout="constrained")
    drawn = [
        _View(axes, places, *coordinates)
        for axes, coordinates in zip(figure.subplots(len(views), squeeze=False)[:, 0], views, strict=True)
    ]
    heading = figure.suptitle(title)

    def show(frame: int) -> list[Any]:
        heading.set_text(f"{title}, t = {times[frame]:.2f} s")
        for view in drawn:
            view.show(frame, radii[frame] / 2)
        return []

    show(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # to lay out every frame takes nearly twice as long
    rate = (len(times) - 1) / max(times[-1] - times[0], 1e-9) * speed
    FuncAnimation(figure, show, frames=len(times)).save(path, writer=PillowWriter(fps=max(1, round(rate))), dpi=70)


class _View:
    """One pair of coordinates of all players."""

    def __init__(self, axes: Axes, places: list[list[list[float]]], first: int, second: int) -> None:
        from matplotlib.patches import Circle

        self.tracks = [[(at[p][first], at[p][second]) for at in places] for p in range(len(places[0]))]
        self.lines, self.discs = [], list[Circle]()
        for player, track in enumerate(self.tracks):
            (line,) = axes.plot(*zip(*track, strict=True), label=f"player {player + 1}")
            self.lines.append(line)
            self.discs.append(Circle(track[0], 0.0, alpha=0.4, color=line.get_color()))
            axes.add_patch(self.discs[-1])
        axes.set(xlabel=f"{'xyz'[first]} [m]", ylabel=f"{'xyz'[second]} [m]", aspect="equal", adjustable="datalim")
        axes.legend(loc="upper right", frameon=False)

    def show(self, frame: int, radius: float) -> None:
        """Draw the paths up to a frame, and discs of a radius at their ends."""
        for line, disc, track in zip(self.lines, self.discs, self.tracks, strict=True):
            line.set_data(*zip(*track[: frame + 1], strict=True))
            disc.set(center=track[frame], radius=radius)
