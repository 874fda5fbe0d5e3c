"""Rows of the table of hard cases: dominoes, what leans, and tall stacks, each object read from a file of its own.

Their boxes are cut finely, with the corners of every face doubled as exporters leave them; what must happen is as of the same
boxes that are not from files.
"""

from functools import cache, partial
from pathlib import Path

import trimesh

from schemas.scene.shape import Asset
from tests.hard_cases.case import settles
from tests.hard_cases.groups import DOMINO_M, LEAN_DEG, PLANK_M, PLANK_THICK_M, Group, dominoes, leaning, stack
from tests.hard_cases.measures import apart, both, heights, tilts
from tests.hard_cases.outside import enter
from tests.kit.shapes import box
from tests.workers.door.oracles import write

SIDE_M = 0.05


@cache
def from_file(kind: str, x_m: float, y_m: float, z_m: float) -> Asset:
    """A box from an OBJ or a GLB, of 192 faces that share no corner, resting on its own frame's z = 0."""
    mesh = box(x_m, y_m, z_m, (0.0, 0.0, z_m / 2)).subdivide().subdivide()
    mesh.unmerge_vertices()

    def made(folder: Path) -> Path:
        return write(folder / f"thing.{kind}", trimesh.Scene(mesh).export(file_type=kind))

    return enter(made)


def cubes(count: int, kinds: tuple[str, ...] = ("obj", "glb")) -> list[Asset]:
    """So many, from OBJ and GLB files in turn."""
    return [from_file(kinds[number % len(kinds)], SIDE_M, SIDE_M, SIDE_M) for number in range(count)]


def _stacked(count: int) -> Group:
    return stack(*cubes(count))


def middles(count: int) -> tuple[float, ...]:
    return tuple(SIDE_M * (number + 0.5) for number in range(count))


FROM_FILES = (
    settles(
        "row of six dominoes from files",
        tilts(*[0.0] * 6, bound_deg=0.1),
        lambda: dominoes(6, 0.0, from_file("obj", *DOMINO_M)),
        again="minute",
    ),
    settles(
        "row of six dominoes from files, the first leaning 14 of 8.9 degrees",
        tilts(*[67.5] * 5, 90.0, bound_deg=22.5),
        lambda: dominoes(6, 14.0, from_file("glb", *DOMINO_M)),
        again="minute",
    ),
    settles(
        "plank leaning on a cube's edge, from files",
        tilts(0.0, 90.0 - LEAN_DEG, bound_deg=0.1),
        lambda: leaning(from_file("obj", 0.1, 0.1, 0.1), from_file("obj", PLANK_M, 0.05, PLANK_THICK_M)),
        again="minute",
    ),
    *(
        settles(
            f"stack of {count} cubes from files",
            both(heights(*middles(count), bound_mm=0.01 * count), apart(1.0)),
            partial(_stacked, count),
            tier=tier,
            again="slow",
        )
        for count, tier in ((10, "minute"), (20, "slow"))
    ),
)
