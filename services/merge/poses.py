"""The article's own tables camPoses.csv, cameras.csv and objects.dat, written in blocks of lines (dataset.md section 1)."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.layout import CAM_POSES, CAMERAS, OBJECTS
from schemas.scene.camera import ROLES
from workers.store.canonical import text_bytes

_ELEMENTS = [f"T{row}{column}" for row in range(4) for column in range(4)]
_CAMERA_COLUMNS = [
    *("pose_id", "parent_id", "role", "width", "height", "fx", "fy", "cx", "cy"),
    *("cx_opencv", "cy_opencv", "depth_units_per_m"),
]
_UNSAFE = re.compile(r"[%\s\x00-\x1f\x7f]")
PLAIN_FROM, PLAIN_BELOW = 1e-4, 1e10
"""Sizes of doubles that Arrow writes as Python's repr does, but for `.0`; others have an exponent in one of them."""


class PoseFiles:
    """The three files in `folder`; takes whole ranges in order. A file is open only while it is written."""

    def __init__(self, folder: Path) -> None:
        self.paths = {name: folder / name for name in (CAM_POSES, CAMERAS, OBJECTS)}
        self._append(CAM_POSES, (",".join(["id", "parent_id", *_ELEMENTS]) + "\n").encode())
        self._append(CAMERAS, (",".join([*_CAMERA_COLUMNS, *_ELEMENTS]) + "\n").encode())
        self._append(OBJECTS, b"")

    def add(self, views: pa.Table, objects: pa.Table) -> None:
        """Takes the next ranges' rows of both tables."""
        self._append(CAM_POSES, cam_pose_lines(views))
        self._append(CAMERAS, camera_lines(views))
        self._append(OBJECTS, object_lines(objects))

    def _append(self, name: str, lines: bytes) -> None:
        with open(self.paths[name], "ab") as file:
            file.write(lines)


def cam_pose_lines(views: pa.Table) -> bytes:
    """`id,parent_id,T00,...,T33` for the input and mirror cameras among rows sorted by pose id."""
    rows = views.select(["pose_id", "parent_id", "T_world_cam"]).filter(_is_pose(views)).combine_chunks()
    return _lines([rows.column("pose_id"), rows.column("parent_id"), _joined(rows.column("T_world_cam"), ",")], ",")


def camera_lines(views: pa.Table) -> bytes:
    """One line for each camera, by pose id and then in the order input, aligned, mirror, projected."""
    rank = pc.index_in(views.column("role"), value_set=pa.array(ROLES))
    order = np.lexsort((rank.to_numpy(), views.column("pose_id").to_numpy()))
    rows = views.select([*_CAMERA_COLUMNS, "T_world_cam"]).take(order).combine_chunks()
    return _lines([*(rows.column(name) for name in _CAMERA_COLUMNS), _joined(rows.column("T_world_cam"), ",")], ",")


def object_lines(objects: pa.Table) -> bytes:
    """`pose_id category instance region u v T00 ... T33` for everything that input and mirror cameras see.

    White space and `%` in names are written as in a URL (`my%20mug`), so every line has 22 words.
    """
    columns = ["pose_id", "category", "instance_id", "region_id", "u", "v", "T_cam_obj"]
    rows = objects.select(columns).filter(_is_pose(objects)).combine_chunks()
    names = [_escaped_all(rows.column(name)) for name in ("category", "instance_id")]
    numbers = [rows.column(name) for name in ("region_id", "u", "v")]
    return _lines([rows.column("pose_id"), *names, *numbers, _joined(rows.column("T_cam_obj"), " ")], " ")


def escaped(name: str) -> str:
    """A name as one word; `urllib.parse.unquote` reverses it."""
    return _UNSAFE.sub(lambda found: "".join(f"%{byte:02X}" for byte in found[0].encode()), name)


def shortest(numbers: pa.Array) -> pa.Array:
    """Doubles as Python's repr writes them, the shortest digits that give them back."""
    values = numbers.to_numpy(zero_copy_only=False)
    sizes = np.abs(values)
    plain = (sizes >= PLAIN_FROM) & (sizes < PLAIN_BELOW) | (sizes == 0)
    texts = numbers.cast(pa.string())
    texts = pc.if_else(pa.array(values == np.trunc(values)), pc.binary_join_element_wise(texts, ".0", ""), texts)
    if plain.all():
        return texts
    return pc.replace_with_mask(texts, pa.array(~plain), pa.array(map(repr, values[~plain].tolist()), pa.string()))


def _joined(matrices: pa.ChunkedArray, separator: str) -> pa.Array:
    """[rows] strings: the sixteen numbers of each matrix."""
    numbers = pa.concat_arrays([chunk.flatten() for chunk in matrices.chunks] or [pa.array([], pa.float64())])
    ends = pa.array(np.arange(0, len(numbers) + 1, 16, dtype=np.int32))
    return pc.binary_join(pa.ListArray.from_arrays(ends, shortest(numbers)), separator)


def _lines(columns: Sequence[pa.ChunkedArray | pa.Array], separator: str) -> bytes:
    """The rows as lines of UTF-8."""
    texts = [_text(column) for column in columns]
    lines = pc.binary_join_element_wise(*texts[:-1], pc.binary_join_element_wise(texts[-1], "", "\n"), separator)
    return b"".join(map(text_bytes, lines.chunks if isinstance(lines, pa.ChunkedArray) else [lines]))


def _text(column: pa.ChunkedArray | pa.Array) -> pa.Array:
    whole = pa.concat_arrays(column.chunks) if isinstance(column, pa.ChunkedArray) and column.chunks else column
    if pa.types.is_floating(whole.type):
        return shortest(whole)
    return whole if pa.types.is_string(whole.type) else whole.cast(pa.string())


def _escaped_all(names: pa.ChunkedArray) -> pa.ChunkedArray:
    """The names as words."""
    coded = names.dictionary_encode().combine_chunks()
    words = pa.array([escaped(name) for name in coded.dictionary.to_pylist()], pa.string())
    return words.take(coded.indices)


def _is_pose(rows: pa.Table) -> pa.ChunkedArray:
    """Which rows are of input and mirror cameras; aligned and projected cameras are in cameras.csv alone."""
    return pc.is_in(rows.column("role"), value_set=pa.array(["input", "mirror"]))
