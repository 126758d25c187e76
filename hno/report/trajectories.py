"""Episodes for other programs: CSV, CommonRoad scenarios and MCAP logs."""

from __future__ import annotations

import csv
import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from hno.data.store import replace_whole
from hno.report.commonroad import write_scenario
from hno.report.runs import RESULTS, read_json

Numbers = NDArray[np.float64]


class Way(NamedTuple):
    """One player on its way: of an episode, or along the equilibrium from the same start."""

    of: str
    """"policy" or "equilibrium"."""
    player: int
    """Counted from 1."""
    t: Numbers
    """s, (K,)."""
    places: Numbers
    """Positions in the common frame, m, (K, d)."""
    states: Numbers
    """(K, n)."""
    controls: Numbers
    """Those that are held from each time on; the last ones twice, (K, m)."""
    value: Numbers
    """Value of the rest, (K,)."""


class Recorded(NamedTuple):
    """A kept episode at every step."""

    number: int
    kind: str
    theta: tuple[float, ...]
    collided: bool
    date: str
    """When it was written, YYYY-MM-DD."""
    paths: list[Way]
    scene: Mapping[str, Any]


def recorded(folder: Path) -> list[Recorded]:
    """The episodes of a run's folder.

    Raises:
        ValueError: it has none at every step, or their files are damaged.
    """
    results = read_json(folder / RESULTS)
    names = [results.get(key) for key in ("episodes", "paths")]
    if not all(isinstance(name, str) for name in names):
        raise ValueError(
            f"{folder} has no episodes at every step: its {RESULTS} names no file of them. hno evaluate {folder} plays "
            "and keeps some."
        )
    file, columns = (folder / Path(str(name)).name for name in names)
    try:
        content, arrays = read_json(file), {key: one.astype(float) for key, one in load_file(columns).items()}
        scene, day = content["scene"], datetime.fromtimestamp(file.stat().st_mtime, UTC).date().isoformat()
        return [
            Recorded(k, one["kind"], tuple(one["theta"]), bool(one["collided"]), day, list(_paths(k, arrays)), scene)
            for k, one in enumerate(content["episodes"])
        ]
    except (LookupError, TypeError, OSError, SafetensorError) as error:
        raise ValueError(f"{file.name} and {columns.name} in {folder} do not fit together ({error!r:.200}).") from error


def _paths(k: int, arrays: Mapping[str, Numbers]) -> Iterator[Way]:
    for of, prefix in (("policy", ""), ("equilibrium", "label_")):
        t, p, x, u, value = (arrays[f"{k}.{prefix}{name}"] for name in ("t", "p", "x", "u", "value"))
        u = np.concatenate([u, u[-1:]]) if len(u) < len(t) else u
        for i in range(x.shape[1]):
            yield Way(of, i + 1, t, p[:, i], x[:, i], u[:, i], value[:, i])


def write_csv(found: Sequence[Recorded], folder: Path) -> list[Path]:
    """One table: a row for every episode, player and time, of the policy and of the equilibrium from the same start."""
    scene, path = found[0].scene, folder / "episodes.csv"
    dimensions = found[0].paths[0].places.shape[1]
    heads = [
        "episode",
        "kind",
        "theta",
        "collided",
        "of",
        "player",
        "t [s]",
        *(f"{axis} [m]" for axis in "xyz"[:dimensions]),
    ]
    heads += [
        *(f"state {name}" for name in scene["states"]),
        *(f"control {name}" for name in scene["controls"]),
        "value",
    ]

    def rows() -> Iterator[list[Any]]:
        for one in found:
            names = [one.number, one.kind, " ".join(f"{entry:g}" for entry in one.theta), int(one.collided)]
            for way in one.paths:
                table = np.column_stack([way.t, way.places, way.states, way.controls, way.value])
                yield from ([*names, way.of, way.player, *(f"{entry:.6g}" for entry in row)] for row in table)

    def write(draft: Path) -> None:
        with draft.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([heads, *rows()])

    replace_whole(path, write)
    return [path]


def write_commonroad(found: Sequence[Recorded], folder: Path) -> list[Path]:
    """A scenario for every episode of cars: the players as obstacles on their lanes; discs decide about collisions.

    Raises:
        ValueError: players have no bodies, as drones; or numbers are not finite.
    """
    _check_finite(found)
    if not found[0].scene["bodies"]:
        raise ValueError("CommonRoad is for cars, and this game has players without bodies. Choose csv or mcap.")
    return [write_scenario(one, folder / f"episode_{one.number}.xml") for one in found]


def write_mcap(found: Sequence[Recorded], folder: Path) -> list[Path]:
    """A log for every episode: one topic per player, of the policy and of the equilibrium; messages are JSON.

    Raises:
        ModuleNotFoundError: mcap is missing.
        ValueError: numbers are not finite, which JSON does not know.
    """
    from mcap.writer import Writer

    _check_finite(found)

    def write(one: Recorded, draft: Path) -> None:
        with draft.open("wb") as file:
            writer = Writer(file)
            writer.start(profile="", library="hno")
            said = {"kind": one.kind, "theta": " ".join(map(str, one.theta)), "collided": str(one.collided)}
            writer.add_metadata("episode", said)
            schema = writer.register_schema("hno.player", "jsonschema", json.dumps(_schema(one)).encode())
            topics = [f"/{way.of}/player_{way.player}" for way in one.paths]
            channels = [writer.register_channel(topic, "json", schema) for topic in topics]
            messages = [(t, k, content) for k, way in enumerate(one.paths) for t, content in _messages(one, way)]
            for t, k, content in sorted(messages, key=lambda message: message[:2]):
                stamp = round(1e9 * t)
                writer.add_message(channels[k], stamp, json.dumps(content).encode(), stamp)
            writer.finish()

    paths = [folder / f"episode_{one.number}.mcap" for one in found]
    for one, path in zip(found, paths, strict=True):
        replace_whole(path, functools.partial(write, one))
    return paths


def _check_finite(found: Sequence[Recorded]) -> None:
    for one in found:
        arrays = (part for way in one.paths for part in (way.places, way.states, way.controls, way.value))
        if not all(np.isfinite(part).all() for part in arrays):
            raise ValueError(f"Episode {one.number} has numbers that are not finite. Choose csv, which can hold them.")


def _schema(one: Recorded) -> dict[str, Any]:
    def of(names: Sequence[str]) -> dict[str, Any]:
        return {"type": "object", "properties": {name: {"type": "number"} for name in names}}

    named = {"position": of("xyz"), "states": of(one.scene["states"]), "controls": of(one.scene["controls"])}
    return {"type": "object", "properties": {"t": {"type": "number"}, "value": {"type": "number"}, **named}}


def _messages(one: Recorded, way: Way) -> Iterator[tuple[float, dict[str, Any]]]:
    for t, place, x, u, value in zip(way.t, way.places, way.states, way.controls, way.value, strict=True):
        named = {"states": _named(one.scene["states"], x), "controls": _named(one.scene["controls"], u)}
        yield float(t), {"t": float(t), "position": _named("xyz", place), **named, "value": float(value)}


def _named(names: Sequence[str], values: Numbers) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=False))


FORMATS: Mapping[str, Callable[[Sequence[Recorded], Path], list[Path]]] = {
    "csv": write_csv,
    "commonroad": write_commonroad,
    "mcap": write_mcap,
}
"""What writes episodes in a format into a folder, and returns the files."""
