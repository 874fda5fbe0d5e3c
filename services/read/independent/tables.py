"""camPoses.csv, cameras.csv and objects.dat against rows of views and objects, line by line."""

import urllib.parse
from collections.abc import Iterable, Iterator

from services.read.independent.pair import Row

_ELEMENTS = [f"T{i}{j}" for i in range(4) for j in range(4)]
_POSES = ("input", "mirror")
_NUMBERS = ("width", "height", "fx", "fy", "cx", "cy", "cx_opencv", "cy_opencv", "depth_units_per_m")


def check_cam_poses(text: str, views: Iterable[Row]) -> Iterator[str]:
    """`id,parent_id,T00..T33`: one line for each input and mirror camera, sorted by id."""
    header, *lines = (line.split(",") for line in text.splitlines())
    if header != ["id", "parent_id", *_ELEMENTS]:
        yield f"camPoses.csv: the header is {','.join(header)}"
    ids = [int(line[0]) for line in lines]
    if ids != sorted(set(ids)):
        yield "camPoses.csv: lines are not sorted by id, or an id stands twice"
    found = dict(zip(ids, lines, strict=True))
    for view in views:
        line = found.get(view["pose_id"])
        if view["role"] in _POSES and (
            line is None or [float(x) for x in line[1:]] != [view["parent_id"], *view["T_world_cam"]]
        ):
            yield f"camPoses.csv: the line of pose {view['pose_id']} is not what views says"


def check_cameras(text: str, views: Iterable[Row]) -> Iterator[str]:
    """One line for each camera, with both pixel conventions; columns are named in the header."""
    header, *lines = (line.split(",") for line in text.splitlines())
    named = [dict(zip(header, line, strict=True)) for line in lines]
    found = {(int(line["pose_id"]), line["role"]): line for line in named}
    for view in views:
        line = found.get((view["pose_id"], view["role"]), {})
        expected = {name: view[name] for name in ("parent_id", *_NUMBERS)}
        expected |= dict(zip(_ELEMENTS, view["T_world_cam"], strict=True))
        wrong = [name for name, value in expected.items() if float(line.get(name, "nan")) != value]
        if wrong:
            yield f"cameras.csv: {', '.join(wrong)} of pose {view['pose_id']} ({view['role']}) are not what views says"


def check_objects(text: str, objects: Iterable[Row]) -> Iterator[str]:
    """`pose_id category instance region u v T00..T33`, sorted by pose id and region."""
    lines = [line.split(" ") for line in text.splitlines()]
    keys = [(int(line[0]), int(line[3])) for line in lines]
    if keys != sorted(set(keys)):
        yield "objects.dat: lines are not sorted by pose id and region, or a key stands twice"
    found = dict(zip(keys, lines, strict=True))
    for row in objects:
        line = found.get((row["pose_id"], row["region_id"]), [])
        told = [*map(urllib.parse.unquote, line[1:3]), *map(float, line[4:])]
        if row["role"] in _POSES and told != [
            *(row["category"], row["instance_id"], row["u"], row["v"]),
            *row["T_cam_obj"],
        ]:
            yield f"objects.dat: the line of pose {row['pose_id']}, region {row['region_id']} is not what objects says"
