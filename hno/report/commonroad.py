"""An episode of cars as a CommonRoad scenario (format 2020a), which needs no package.

commonroad-io pins an old protobuf, which cannot stand beside those of onnx and wandb.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent

import numpy as np

from hno.data.store import replace_whole

if TYPE_CHECKING:
    from hno.report.trajectories import Recorded, Way

MARGIN = 20.0
"""How far roads go on beyond all that happens, m."""
NOWHERE = {"geoNameId": "-999", "gpsLatitude": "999", "gpsLongitude": "999"}
"""What the format has for a place that is none."""


def write_scenario(one: Recorded, path: Path) -> Path:
    """Write the players of an episode, not the equilibrium, with the roads of the scene; returns the file."""
    played, ids = [way for way in one.paths if way.of == "policy"], count(1)
    said = f"hno, {one.kind} episode at types {one.theta}; circles around the centres decide about collisions"
    root = Element(
        "commonRoad", timeStepSize=f"{played[0].t[1] - played[0].t[0]:.6g}", commonRoadVersion="2020a", author="hno",
        affiliation="", source=said, benchmarkID=f"ZAM_Hno-{one.number + 1}_1_T-1", date=one.date,
    )  # fmt: skip
    location = SubElement(root, "location")
    for name, value in NOWHERE.items():
        SubElement(location, name).text = value
    SubElement(SubElement(root, "scenarioTags"), "simulated")
    places = np.concatenate([way.places for way in played])
    for road in one.scene["roads"]:
        _lanelets(root, road, places, ids)
    for way, body in zip(played, one.scene["bodies"], strict=True):
        _obstacle(root, way, body, next(ids))
    indent(root)
    replace_whole(path, lambda draft: ElementTree(root).write(draft, encoding="utf-8", xml_declaration=True))
    return path


def _lanelets(root: Element, road: Mapping[str, Any], places: Any, ids: count[int]) -> None:
    """Lanes between the edges and marks of a road, all along its axis."""
    axis = road["axis"]
    along = places[:, axis].min() - MARGIN, places[:, axis].max() + MARGIN
    lines = sorted([*road["edges"], *road["marks"]], reverse=not axis)  # from left to right
    for bounds in pairwise(lines):
        lanelet = SubElement(root, "lanelet", id=str(next(ids)))
        for name, across in zip(("leftBound", "rightBound"), bounds, strict=True):
            bound = SubElement(lanelet, name)
            for end in along:
                _point(bound, (across, end) if axis else (end, across))


def _obstacle(root: Element, way: Way, body: tuple[float, float], number: int) -> None:
    motion = np.gradient(way.places, way.t, axis=0)
    angles, speeds = np.arctan2(motion[:, 1], motion[:, 0]), np.linalg.norm(motion, axis=1)
    obstacle = SubElement(root, "dynamicObstacle", id=str(number))
    SubElement(obstacle, "type").text = "car"
    rectangle = SubElement(SubElement(obstacle, "shape"), "rectangle")
    for name, side in zip(("length", "width"), body, strict=True):
        SubElement(rectangle, name).text = f"{side:g}"
    course = None
    for k, place in enumerate(way.places):
        parent = obstacle if course is None else course
        state = SubElement(parent, "initialState" if course is None else "state")
        _point(SubElement(state, "position"), place)
        for name, value in (("orientation", angles[k]), ("time", k), ("velocity", speeds[k])):
            SubElement(SubElement(state, name), "exact").text = f"{value:.9g}"
        course = SubElement(obstacle, "trajectory") if course is None else course


def _point(parent: Element, place: Any) -> None:
    point = SubElement(parent, "point")
    for name, value in zip("xy", place, strict=True):
        SubElement(point, name).text = f"{value:.9g}"
