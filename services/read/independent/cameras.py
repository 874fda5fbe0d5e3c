"""Cameras that a job names (`cameras.more`), by their meaning: how many, their lens, where they stand, where they look.

Conventions are those of derive.py. What is drawn at random is held to its bounds; what follows from a number of its own, as the
turn of a whole sphere does, is taken from the first view, and all others must follow from it.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import dataset

from services.read.independent.rays import NEAR_M, Array

Entry = Mapping[str, Any]

STORED = 1e-6
"""Largest error of a direction, and of a distance as a share of it: stored shapes, which objects' middles are of, are float32."""

FIT, INSIDE = 0.5, 0.95
"""What `fit` stands for: the share of the picture that the bounding sphere covers; the share of its way to an edge at most."""

LEVEL = 1e-3
"""A camera so near to straight above or below has no direction around, and no roll."""


def _sphere(count: int, pattern: str, radius_m: object, height_m: object = None) -> Entry:
    band = {"inclination_rad": [-math.pi / 2.0, math.pi / 2.0], "height_m": height_m}
    return {"count": count, "pattern": pattern, "radius_m": radius_m, **band}


def _ring(count: int, elevation_deg: float, radius_m: float, azimuth_deg: float = 0.0, start: str = "world") -> Entry:
    ends = {"inclination_rad": [math.radians(elevation_deg)] * 2, "start_rad": [math.radians(azimuth_deg)] * 2}
    return {"count": count, "radius_m": radius_m, "start": start, **ends}


FOV_35_OF_32_MM = 2.0 * math.degrees(math.atan(16.0 / 35.0))

PRESETS: Mapping[str, tuple[float, str, float, Sequence[Entry]]] = {
    "zero123": (FOV_35_OF_32_MM, "side", 1.0, [_sphere(12, "cube", [1.5, 2.2])]),
    "syncdreamer": (FOV_35_OF_32_MM, "side", 1.0, [_ring(16, 30.0, 1.5)]),
    "zero123plus": (
        30.0,
        "sphere",
        0.5,
        [_ring(1, -10.0 if n % 2 else 20.0, 1.8660254037844386, 30.0 + 60.0 * n, "input") for n in range(6)],
    ),
    "lrm": (50.0, "side", 2.0, [_sphere(32, "cube", [2.0, 3.5], [-0.75, 1.6])]),
    "trellis": (40.0, "side", 1.0, [_sphere(150, "trellis", 2.0)]),
}
"""Of the projects' own scripts: horizontal field of view, degrees; what is one long, how long; the orbits (docs/studio.md)."""


def sensor_of(entry: Entry, sensor: Entry) -> Entry:
    """The pinhole camera of an entry by name."""
    sensor = entry["sensor"] or sensor
    fov_deg = entry["fov_deg"] or (PRESETS[entry["preset"]][0] if entry["preset"] else None)
    if fov_deg is None:
        return sensor
    focal = sensor["width"] / 2.0 / math.tan(math.radians(fov_deg) / 2.0)
    return {**sensor, "fx": focal, "fy": focal}


PINHOLE = ("width", "height", "fx", "fy", "cx", "cy")


@dataclass(frozen=True, eq=False)
class Stand:
    """A row of a table of poses: T [4, 4], camera to world, or to the first object; the pinhole camera, where it has one."""

    T: Array
    of_object: bool
    pinhole: Entry


def read_stands(path: Path, scene_id: int) -> list[Stand]:
    """The rows of a scene in a table (.csv, .parquet, .json), in order; without scene_id every scene has all."""
    if path.suffix.lower() == ".json":
        rows = [row for row in json.loads(path.read_bytes()) if row.get("scene_id", scene_id) == scene_id]
    else:
        table = dataset.dataset(path, format=path.suffix.lower()[1:])
        only = dataset.field("scene_id") == scene_id if "scene_id" in table.schema.names else None
        rows = table.to_table(filter=only, use_threads=False).to_pylist()
    return [_stand(row) for row in rows]


def _stand(row: Entry) -> Stand:
    """R (R^T R)^(-1/2) is the rotation that is nearest to R, by its polar decomposition."""
    frame = next((name for name in ("T_world_cam", "T_obj_cam") if name in row), "")
    given = row[frame] if frame else [row[f"T{i}{j}"] for i in range(4) for j in range(4)]
    T = np.reshape(json.loads(given) if isinstance(given, str) else given, (4, 4)).astype(np.float64)
    squares, axes = np.linalg.eigh(T[:3, :3].T @ T[:3, :3])
    T[:3, :3], T[3] = T[:3, :3] @ (axes / np.sqrt(squares)) @ axes.T, (0.0, 0.0, 0.0, 1.0)
    return Stand(T, frame == "T_obj_cam", {name: row[name] for name in PINHOLE if name in row})


def orbits_of(entry: Entry) -> Sequence[Entry]:
    """The rings and spheres of an entry, one after another."""
    if entry["preset"]:
        return PRESETS[entry["preset"]][3]
    return [entry[kind] for kind in ("ring", "sphere") if entry[kind]]


def beside_transform(entry: Entry) -> Array:
    """[4, 4]: the camera's frame in that of the camera that it is fixed to; turned about that one's x, then y, then z axis."""
    a, b, c = np.radians(entry["rotation_deg"])
    x = [[1.0, 0.0, 0.0], [0.0, math.cos(a), -math.sin(a)], [0.0, math.sin(a), math.cos(a)]]
    y = [[math.cos(b), 0.0, math.sin(b)], [0.0, 1.0, 0.0], [-math.sin(b), 0.0, math.cos(b)]]
    z = [[math.cos(c), -math.sin(c), 0.0], [math.sin(c), math.cos(c), 0.0], [0.0, 0.0, 1.0]]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.array(z) @ np.array(y) @ np.array(x), entry["offset_m"]
    return T


@dataclass(frozen=True, eq=False)
class Subject:
    """What cameras are placed about: points [N, 3] of the objects at rest, world; the table's height.

    nearest_m: the least depth that is stored.
    """

    points: Array
    top_m: float
    nearest_m: float

    @property
    def side_m(self) -> float:
        """Of the box of the objects as they lie, the longest."""
        return float(np.ptp(self.points, axis=0).max())

    @property
    def middle(self) -> Array:
        """[3]: of the box of the objects."""
        middle: Array = (self.points.min(axis=0) + self.points.max(axis=0)) / 2.0
        return middle

    @property
    def radius_m(self) -> float:
        """Of the sphere about the middle that bounds the objects."""
        return float(np.linalg.norm(self.points - self.middle, axis=1).max())

    def look_at(self, about: object) -> Array:
        """[3]: the point that cameras look at."""
        named = {"object": self.middle, "table": np.array([0.0, 0.0, self.top_m]), "world": np.zeros(3)}
        return named[about] if isinstance(about, str) else np.array(about)


def check_stands(entry: Entry, T: Array, subject: Subject, sensor: Entry, T_first: Array) -> Iterator[str]:
    """Cameras [N, 4, 4] of an entry's rings and spheres, a sentence for what is off; `T_first`: the first input camera."""
    unit_m, start, centre = 1.0, 0, subject.look_at(entry["about"])
    if entry["preset"]:
        _, of, length, _ = PRESETS[entry["preset"]]
        unit_m = (subject.side_m if of == "side" else subject.radius_m) / length
    for orbit in orbits_of(entry):
        part = T[start : start + orbit["count"]]
        start += orbit["count"]
        away = part[:, :3, 3] - centre
        distance_m = np.linalg.norm(away, axis=1)
        towards = away / distance_m[:, None]
        if (off := np.abs(towards + part[:, :3, 2]).max()) > STORED:
            yield f"does not look at {entry['about']}: its axis is off by {off:.3g}"
        low, high = _distances(orbit["radius_m"], subject, unit_m, sensor)
        if not (low * (1.0 - STORED) <= distance_m.min() and distance_m.max() <= high * (1.0 + STORED)):
            yield f"stands {distance_m.min():.6g} to {distance_m.max():.6g} m away, radius_m gives {low:.6g} to {high:.6g}"
        for name, ends, values in (
            ("inclination_rad", np.sin(orbit["inclination_rad"]), towards[:, 2]),
            ("height_m", orbit.get("height_m"), distance_m / unit_m * towards[:, 2]),
            ("roll_deg", entry["roll_deg"], _rolls_deg(part, entry["roll_deg"][0])),
        ):
            if (
                ends is not None
                and len(values)
                and not (ends[0] - STORED <= values.min() and values.max() <= ends[1] + STORED)
            ):
                yield f"is outside {name}"
        yield from _check_pattern(orbit, towards, T_first)


def _distances(radius_m: object, subject: Subject, unit_m: float, sensor: Entry) -> tuple[float, float]:
    """Least and most distance. From d, a sphere of radius R fills a cone whose half angle has the sine R / d."""
    if isinstance(radius_m, str):
        share = FIT if radius_m == "fit" else float(radius_m.rstrip("% ")) / 100.0
        width, height, fx, fy, cx, cy = (sensor[name] for name in ("width", "height", "fx", "fy", "cx", "cy"))
        edges = min(min(cx, width - cx) / fx, min(cy, height - cy) / fy)
        half = math.atan(min(math.sqrt(share * width * height / (math.pi * fx * fy)), INSIDE * edges))
        return (max(subject.radius_m / math.sin(half), subject.radius_m + max(NEAR_M, subject.nearest_m) / INSIDE),) * 2
    low, high = (float(end) * unit_m for end in np.broadcast_to(np.array(radius_m), 2))
    return low, high


def _rolls_deg(T: Array, least: float) -> Array:
    """Turns about the optical axes from where the image's x axis is level, at least `least`, of cameras that have one."""
    T = T[np.hypot(T[:, 0, 2], T[:, 1, 2]) > LEVEL]
    level = np.cross(T[:, :3, 2], [0.0, 0.0, 1.0])
    level /= np.linalg.norm(level, axis=1)[:, None]
    down = np.cross(T[:, :3, 2], level)
    roll = np.degrees(np.arctan2((T[:, :3, 0] * down).sum(axis=1), (T[:, :3, 0] * level).sum(axis=1)))
    least -= STORED
    return least + np.mod(roll - least, 360.0)


def _check_pattern(orbit: Entry, towards: Array, T_first: Array) -> Iterator[str]:
    """Directions [N, 3] to the cameras of a ring or a sphere: those of a random pattern have none."""
    count, pattern = orbit["count"], orbit.get("pattern", "ring")
    if pattern in ("uniform", "cube"):
        return
    level = np.hypot(towards[:, 0], towards[:, 1])
    around, k = np.arctan2(towards[:, 1], towards[:, 0]), np.arange(count)
    reverse = np.array([int(f"{n:b}"[::-1], 2) / 2.0 ** len(f"{n:b}") for n in range(count)])
    turns = {"ring": k / count, "fibonacci": k / ((1.0 + math.sqrt(5.0)) / 2.0) ** 2}.get(pattern, reverse)
    known = np.flatnonzero(level > LEVEL)
    off = around[known] - around[known[:1]] - 2.0 * math.pi * (turns[known] - turns[known[:1]])
    if (np.abs(np.sin(off / 2.0)) * level[known] > STORED).any():
        yield f"is not where its number stands in the pattern {pattern}: its direction around is off"
    if pattern == "ring":
        first = 0.0 if orbit["start"] == "world" else math.atan2(-T_first[1, 2], -T_first[0, 2])
        low, high = orbit["start_rad"]
        begun = np.mod(around[:1] - first - low + STORED, 2.0 * math.pi)
        if level[0] > LEVEL and begun > high - low + 2.0 * STORED:
            yield "does not begin at start_rad"
        return
    low, high = np.sin(orbit["inclination_rad"])
    if high - low < STORED:
        return
    share = (towards[:, 2] - low) / (high - low)
    if pattern == "trellis":
        share = np.where(share < 0.5, share / 2.0, 1.5 * share - 0.5)
    within, slack = share * count - k, STORED * count / (high - low)
    first = 0.5 if pattern == "fibonacci" else float(within[0])
    if np.abs(within - first).max() > slack or not -slack <= first < 1.0 + slack:
        yield f"is not where its number stands in the pattern {pattern}: its height is off"
