"""Pure: the counts that a mesh file from outside declares, and the caps on them."""

import re
import struct
from pathlib import Path

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits

LEAST_BYTES = 8
"""No format writes a vertex or a face in fewer: `v 0 0 0` and its line end."""

_PLY_ELEMENT = re.compile(rb"^element\s+(\w+)\s+(\d+)", re.MULTILINE)


def check_counts(path: Path, vertices: int, faces: int, limits: MeshLimits) -> None:
    """MeshError `too_large` where a count is over its cap."""
    for name, count, cap in (("vertices", vertices, limits.max_vertices), ("faces", faces, limits.max_faces)):
        if count > cap:
            raise MeshError("too_large", f"{path} has {count} {name}, over max_{name} = {cap}")


def may_be_too_large(data: bytes, limits: MeshLimits) -> bool:
    """Whether a file is long enough to hold more than the caps allow; a shorter one needs no counting."""
    return len(data) > LEAST_BYTES * min(limits.max_vertices, limits.max_faces)


def declared_counts(kind: str, data: bytes) -> tuple[int, int]:
    """How many vertices and faces a file says that it holds, read without parsing it; (0, 0) where it does not say."""
    if kind == ".obj":
        return data.count(b"\nv "), data.count(b"\nf ")
    if kind == ".ply":
        counts = {name: int(count) for name, count in _PLY_ELEMENT.findall(data[: data.find(b"end_header")][:65536])}
        if any(count > len(data) for count in counts.values()):
            raise MeshError(
                "unreadable", f"the PLY header promises {max(counts.values())} elements in {len(data)} bytes"
            )
        return counts.get(b"vertex", 0), counts.get(b"face", 0)
    if kind == ".stl" and len(data) >= 84 and len(data) == 84 + 50 * struct.unpack_from("<I", data, 80)[0]:
        faces = (len(data) - 84) // 50
        return 3 * faces, faces
    return 0, data.count(b"endfacet")
