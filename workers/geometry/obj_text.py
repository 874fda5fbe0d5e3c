"""Convex parts as the text of an OBJ file. Pure."""

from collections.abc import Sequence
from functools import lru_cache

from schemas.base import Array


def obj_of(parts: Sequence[Array]) -> bytes:
    """An object `part0`, `part1` ... for each part [N, 3], of which a reader wants the vertices: its faces are a fan over all.

    Nine significant digits: those that float32 keeps.
    """
    texts = (f"o part{n}\n" + _layout_of(len(part)) % tuple(part.ravel().tolist()) for n, part in enumerate(parts))
    return "".join(texts).encode("ascii")


@lru_cache(1024)
def _layout_of(count: int) -> str:
    """The lines of a part with so many vertices. Faces count from the last vertex back, as OBJ allows, in any part alike."""
    faces = (f"f {-count} {k - count} {k - count + 1}\n" for k in range(1, count - 1))
    return "v %.9g %.9g %.9g\n" * count + "".join(faces)
