"""A picture of the collision rate over the players' types."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hno.report.picture import PlotsMissingError

FULL = 0.05
"""Rate at which the colour scale ends unless a type is worse."""


def collision_map(table: Sequence[Mapping[str, Any]], path: Path, title: str) -> None:
    """Draw the collision rate of every evaluated pair of types with its number of safe starts; seen types are framed.

    Args:
        table: rows of results.json's `table`.
        path: file to write; its suffix chooses the format.
        title: a line above the picture.

    Raises:
        PlotsMissingError: matplotlib is not installed.
        ValueError: there are no rows, or the game does not have two players.
    """
    if not table or any(len(row["theta"]) != 2 for row in table):
        raise ValueError("A map over types needs evaluated types of two players.")
    try:
        from matplotlib.colors import Normalize
        from matplotlib.figure import Figure
        from matplotlib.patches import Rectangle
    except ModuleNotFoundError as error:
        raise PlotsMissingError("Pictures need matplotlib: pip install 'hno[plots]'.") from error
    columns, rows = (sorted({row["theta"][player] for row in table}) for player in (0, 1))
    scale = Normalize(0, max(FULL, *(row["rate"] or 0.0 for row in table)))
    size = max(5.0, 2 + 0.9 * len(columns)), max(3.0, 1.4 + 0.8 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    image = axes.imshow([[float("nan")] * len(columns)] * len(rows), cmap="YlOrRd", norm=scale, origin="lower")
    for row in table:
        x, y = columns.index(row["theta"][0]), rows.index(row["theta"][1])
        share = None if row["rate"] is None else float(scale(row["rate"]))
        color = "0.9" if share is None else image.get_cmap()(share)
        edge, width = ("black", 2.0) if row["seen"] else ("white", 0.5)
        axes.add_patch(Rectangle((x - 0.47, y - 0.47), 0.94, 0.94, facecolor=color, edgecolor=edge, linewidth=width))
        text = "n/a" if row["rate"] is None else f"{100 * row['rate']:.3g} %"
        ink = "white" if share is not None and share > 0.6 else "black"
        axes.text(x, y, f"{text}\nof {row['safe_starts']}", ha="center", va="center", color=ink, fontsize=9)
    axes.set_xticks(range(len(columns)), [f"{theta:g}" for theta in columns])
    axes.set_yticks(range(len(rows)), [f"{theta:g}" for theta in rows])
    axes.set(xlabel="type of player 1", ylabel="type of player 2", title=f"{title}\nframed: types with labels")
    figure.colorbar(image, label="collisions per safe start", format=lambda rate, _: f"{100 * rate:g} %")
    figure.savefig(path, dpi=110)
