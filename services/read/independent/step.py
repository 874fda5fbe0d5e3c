"""`verso verify --independent N`: labels derived a second time, from the definitions of Staszak and Belter 2024.

`verso verify` derives them by the producer's own functions, which finds damage and never a wrong formula. This package
imports nothing else of the project: rows come as dictionaries, files as bytes.
"""

import urllib.parse
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from services.read.independent import derive, poses
from services.read.independent.derive import Row, StoredPair

_ELEMENTS = [f"T{i}{j}" for i in range(4) for j in range(4)]
_CAMERA_COLUMNS = (
    *("pose_id", "parent_id", "role", "width", "height", "fx", "fy", "cx", "cy", "cx_opencv", "cy_opencv"),
    "depth_units_per_m",
)


def list_underived(job: Mapping[str, Any]) -> list[str]:
    """Stored values that have no second derivation for this job, a sentence each."""
    told = ["visible_fraction, mirror_agreement and projected_hidden_share are not derived"]
    sensor, projection = job["sensor"], job["images"]["projection"]
    if job.get("captures") is not None:
        told.append(
            "poses of input cameras, and depth and colour of mirror views, follow from photographs: not derived"
        )
    if projection["enabled"] and not _has_plain_points(job):
        told.append("projected images are not derived: images.projection.splat or hidden_point_removal is on")
    elif projection["enabled"] and sensor["distortion"]:
        told.append("colours of projected images are not derived: sensor.distortion is on")
    if sensor["depth_noise"]:
        told.append("depth is not compared with the floor's plane: sensor.depth_noise is on")
    return told


def _has_plain_points(job: Mapping[str, Any]) -> bool:
    """Whether every projected point fills one pixel and none is removed."""
    projection = job["images"]["projection"]
    return projection["splat"] == 1 and not projection["hidden_point_removal"]


def check_pair(pair: StoredPair) -> list[str]:
    """Stored values of one pair that differ from their definitions, a sentence each."""
    cameras, projection = pair.job["cameras"], pair.job["images"]["projection"]
    switches = {"aligned": cameras["depth"], "mirror": cameras["mirror"], "projected": projection}
    expected = {"input", *(role for role, branch in switches.items() if branch["enabled"])}
    if set(pair.views) != expected:
        return [f"scene {pair.scene['scene_id']}: has views {sorted(pair.views)}, and must have {sorted(expected)}"]
    faults = [fault for view in pair.views.values() for fault in derive.check_images(pair, view)]
    if faults:
        return faults
    for role, view in pair.views.items():
        own = [*derive.check_camera(pair, view), *derive.check_patches(pair, view)]
        if role != "projected":
            own += [*derive.check_depth(pair, view), *derive.check_labels(pair, view)]
        elif _has_plain_points(pair.job):
            own += derive.check_projection(pair)
        faults += [f"pose {view['pose_id']} ({role}): {fault}" for fault in own]
    own = [*poses.check_poses(pair), *(poses.check_board if pair.is_captured else poses.check_orbit)(pair)]
    return faults + [f"pair {pair.views['input']['pose_id']}: {fault}" for fault in own]


def check_merged(read: Callable[[str], bytes], views: Sequence[Row], objects: Sequence[Row]) -> Iterator[str]:
    """camPoses.csv and objects.dat (input and mirror cameras) and cameras.csv, line by line against rows of the tables."""
    poses, seen = ([row for row in rows if row["role"] in ("input", "mirror")] for rows in (views, objects))
    labels = ("pose_id", "category", "instance_id", "region_id", "u", "v")
    for path, header, columns, key, rows in (
        ("camPoses.csv", ["id", "parent_id", *_ELEMENTS], ("pose_id", "parent_id"), ("pose_id",), poses),
        ("cameras.csv", [*_CAMERA_COLUMNS, *_ELEMENTS], _CAMERA_COLUMNS, ("pose_id", "role"), views),
        ("objects.dat", None, labels, ("pose_id", "region_id"), seen),
    ):
        try:
            lines = [line.split(",") if header else line.split(" ") for line in read(path).decode().splitlines()]
            if header and (found := lines.pop(0)) != header:
                yield f"{path}: the header is {','.join(found)}"
            yield from (f"{path}: {fault}" for fault in _check_lines(lines, columns, key, rows))
        except (FileNotFoundError, ValueError, KeyError, IndexError) as error:
            yield f"{path}: cannot be read: {error}"


def _check_lines(
    lines: Sequence[Sequence[str]], columns: Sequence[str], key: Sequence[str], rows: Sequence[Row]
) -> Iterator[str]:
    """Lines in the order of their keys, each with the values of its row and its matrix; names are written as in a URL."""
    roles = {role: number for number, role in enumerate(derive.IMAGES)}
    table = {}
    for line in lines:
        named = dict(zip([*columns, *_ELEMENTS], map(urllib.parse.unquote, line), strict=True))
        table[tuple(roles[named[name]] if name == "role" else int(named[name]) for name in key)] = named
    if len(table) != len(lines) or list(table) != sorted(table):
        yield f"lines are not sorted by {' and '.join(key)}, or a key stands twice"
    for row in rows:
        values = [*(row[name] for name in columns), *row["T_cam_obj" if "T_cam_obj" in row else "T_world_cam"]]
        named = table.get(tuple(roles[row[name]] if name == "role" else row[name] for name in key), {})
        pairs = zip([*columns, *_ELEMENTS], values, strict=True)
        if wrong := [name for name, value in pairs if name not in named or type(value)(named[name]) != value]:
            at = ", ".join(f"{name} {row[name]}" for name in key)
            yield f"{', '.join(wrong)} in the line of {at} are not what the tables say"
