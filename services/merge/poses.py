"""The article's own tables camPoses.csv, cameras.csv and objects.dat, written line by line (dataset.md section 1)."""

import re
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.layout import CAM_POSES, CAMERAS, OBJECTS
from schemas.scene.camera import ROLES

_ELEMENTS = [f"T{row}{column}" for row in range(4) for column in range(4)]
_CAMERA_COLUMNS = [
    *("pose_id", "parent_id", "role", "width", "height", "fx", "fy", "cx", "cy"),
    *("cx_opencv", "cy_opencv", "depth_units_per_m"),
]
_UNSAFE = re.compile(r"[%\s\x00-\x1f\x7f]")


class PoseFiles:
    """The three files in `folder`, open for writing; takes whole ranges in order."""

    def __init__(self, folder: Path) -> None:
        self.paths = {name: folder / name for name in (CAM_POSES, CAMERAS, OBJECTS)}
        self._files = {name: open(path, "w", encoding="utf-8", newline="\n") for name, path in self.paths.items()}  # noqa: SIM115
        self._files[CAM_POSES].write(",".join(["id", "parent_id", *_ELEMENTS]) + "\n")
        self._files[CAMERAS].write(",".join([*_CAMERA_COLUMNS, *_ELEMENTS]) + "\n")

    def add(self, views: pa.Table, objects: pa.Table) -> None:
        """Takes the next range's rows of both tables."""
        self._files[CAM_POSES].writelines(cam_pose_lines(views))
        self._files[CAMERAS].writelines(camera_lines(views))
        self._files[OBJECTS].writelines(object_lines(objects))

    def close(self) -> None:
        """Closes the files."""
        for file in self._files.values():
            file.close()


def cam_pose_lines(views: pa.Table) -> Iterator[str]:
    """`id,parent_id,T00,...,T33` for the input and mirror cameras among rows sorted by pose id."""
    rows = views.select(["pose_id", "parent_id", "T_world_cam"]).filter(_is_pose(views))
    for pose_id, parent_id, matrix in zip(*(column.to_pylist() for column in rows.columns), strict=True):
        yield f"{pose_id},{parent_id},{','.join(map(repr, matrix))}\n"


def camera_lines(views: pa.Table) -> Iterator[str]:
    """One line for each camera, by pose id and then in the order input, aligned, mirror, projected."""
    rows = views.select([*_CAMERA_COLUMNS, "T_world_cam"]).to_pylist()
    rows.sort(key=lambda row: (row["pose_id"], ROLES.index(row["role"])))
    for row in rows:
        matrix = row.pop("T_world_cam")
        values = (value if isinstance(value, str) else repr(value) for value in row.values())
        yield f"{','.join(values)},{','.join(map(repr, matrix))}\n"


def object_lines(objects: pa.Table) -> Iterator[str]:
    """`pose_id category instance region u v T00 ... T33` for everything that input and mirror cameras see.

    White space and `%` in names are written as in a URL (`my%20mug`), so every line has 22 words.
    """
    columns = ["pose_id", "category", "instance_id", "region_id", "u", "v", "T_cam_obj"]
    rows = objects.select(columns).filter(_is_pose(objects))
    for pose_id, category, instance, region, u, v, matrix in zip(*(c.to_pylist() for c in rows.columns), strict=True):
        words = [str(pose_id), escaped(category), escaped(instance), str(region), str(u), str(v), *map(repr, matrix)]
        yield " ".join(words) + "\n"


def escaped(name: str) -> str:
    """A name as one word; `urllib.parse.unquote` reverses it."""
    return _UNSAFE.sub(lambda found: "".join(f"%{byte:02X}" for byte in found[0].encode()), name)


def _is_pose(rows: pa.Table) -> pa.ChunkedArray:
    """Which rows are of input and mirror cameras; aligned and projected cameras are in cameras.csv alone."""
    return pc.is_in(rows.column("role"), value_set=pa.array(["input", "mirror"]))
