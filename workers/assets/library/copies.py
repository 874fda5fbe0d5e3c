"""Pure: what `verso init` found in a folder, and of its meshes those that are another one again.

Such as a collision shape, a coarser level, a double.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import PurePosixPath

import numpy as np

from workers.assets.library.placement import LOOK_SIDE, Measured
from workers.door.meshes.urdf import POSED

PART, COPY = "part", "copy"
"""The reasons why a mesh is not an object by itself: a file names it; it is a collision shape, a coarser level, a double."""


@dataclass(frozen=True)
class Item:
    """A file that can be used, what was measured of it, and one digest over all files that it reads."""

    path: str
    measured: Measured
    digest: str

    @property
    def suffix(self) -> str:
        """The end of its name, in small letters."""
        return self.path[self.path.rfind(".") :].lower()

    @property
    def diagonal(self) -> float:
        """Of its bounding box, in units of the file."""
        return float(sum(extent * extent for extent in self.measured.extents) ** 0.5)


@dataclass(frozen=True)
class LeftOut:
    """A file that is not used: why in a word, and in a sentence without its subject, with the remedy."""

    path: str
    reason: str
    why: str


_COLLIDES = "col|coll|collisions?|colliders?|v-?hacd|coacd|convex|hulls?|ch|physics|phys"
_NAMED = re.compile(rf"(.+?)(?:[\s_.-]+(?:{_COLLIDES})(?:[\s_.-]*\d+)*)+", re.IGNORECASE)
_NAMED_BEFORE = re.compile(r"(?:UCX|UBX|USP|UCP)_(.+?)(?:_\d+)?")
"""As Unreal has it."""
_ALONE = re.compile(r"(?:collisions?|colliders?|v-?hacd|coacd)(?:[\s_.-]*(?:mesh|model))?", re.IGNORECASE)
"""A name that says nothing else."""
_FOLDER = re.compile(rf"(?:{_COLLIDES})(?:[\s_.-]*mesh(?:es)?)?", re.IGNORECASE)
_LEVEL = re.compile(r"(.+?)(?:[\s_.-]*lod|[\s_.-]+res)[\s_.-]*(\d+)", re.IGNORECASE)
"""Also as Stanford's scans have it: bun_zipper_res2."""
_EVALUATION = re.compile(r"(.*/|)models_[a-z]+/(obj_\d+\.ply)")
"""BOP has an object's coarser meshes beside its `models`."""
_SEEN = re.compile(r"[\s_.-]+(?:vis|visual)$", re.IGNORECASE)

FORMAT_FOLDER = r"(?:obj|stl|ply|glb|gltf|urdf|mjcf|sdf|dae|off|fbx|3d)(?:[\s_.-]*(?:format|files?|models?))?"
"""The name of a folder that says in what format its files are."""
_FORMAT = re.compile(FORMAT_FOLDER, re.IGNORECASE)


def find_copies(paths: Iterable[str], everything: Sequence[str]) -> dict[str, str]:
    """Of the paths, by their names: collision shapes and coarser levels of detail, with the file that each belongs to.

    Only what belongs to some file of `everything` is a copy: a collision shape alone is all that there is of an object.
    """
    split = {path: _split(path) for path in everything}
    posed = {path for path in everything if PurePosixPath(path).suffix.lower() in POSED}
    originals = [path for path, (_, level) in split.items() if level is None or path in posed]
    levels: dict[tuple[str, str], tuple[int, str]] = {}
    for path, (stem, level) in split.items():
        if level is not None and level >= 0:
            key = _parent(path), stem
            levels[key] = min(levels.get(key, (level, path)), (level, path))
    by_folder: dict[str, list[str]] = {}
    for path in originals:
        by_folder.setdefault(_parent(path), []).append(path)
    copies = {}
    for path in paths:
        if (match := _EVALUATION.fullmatch(path)) and (model := f"{match[1]}models/{match[2]}") in split:
            copies[path] = f"made for evaluation, of {model}"
            continue
        stem, level = split[path]
        if level is None or path in posed:
            continue
        finest = levels.get((_parent(path), stem), (0, path))[1] if level >= 0 else None
        near = _near(path, by_folder) if finest in (None, path) else []
        of = next((original for original in near if _stem(original) == stem), None)
        if of is None and level < 0:
            alike = [original for original in near if stem in _stem(original) or _stem(original) in stem]
            meshes = [original for original in near if original not in posed] or near
            of = min(alike or (meshes if len(meshes) == 1 or _in_folder(path) else []), default=None)
        of = of or (finest if finest != path else None)
        if of is not None:
            copies[path] = f"{'collision shape' if level < 0 else 'coarser level of detail'} of {of}"
    return copies


def _split(path: str) -> tuple[str, int | None]:
    """The name of what a file is a copy of, and the level of detail, -1 for a collision shape, None where it is no copy."""
    stem = _stem(path)
    if match := _LEVEL.fullmatch(stem):
        return match[1], int(match[2])
    if match := _NAMED.fullmatch(stem) or _NAMED_BEFORE.fullmatch(PurePosixPath(path).stem):
        return match[1].lower(), -1
    if _ALONE.fullmatch(stem):
        return "", -1
    return (stem, -1) if _in_folder(path) else (stem, None)


def _in_folder(path: str) -> bool:
    """Whether it lies in a folder of collision shapes."""
    return any(_FOLDER.fullmatch(name) for name in PurePosixPath(path).parts[:-1])


def _near(path: str, by_folder: Mapping[str, list[str]]) -> list[str]:
    """What lies in its folder or, where it lies in a folder of collision shapes, in or below the one above that."""
    parts = PurePosixPath(path).parts[:-1]
    depth = next((k for k, name in enumerate(parts) if _FOLDER.fullmatch(name)), None)
    if depth is None:
        return by_folder.get("/".join(parts), [])
    above = "/".join(parts[:depth])
    return [
        other
        for folder, some in by_folder.items()
        if f"{folder}/".startswith(f"{above}/" if above else "")
        for other in some
    ]


def _parent(path: str) -> str:
    return path.rpartition("/")[0]


def _stem(path: str) -> str:
    return _SEEN.sub("", PurePosixPath(path).stem).lower()


ALIKE = 1e-3
"""Relative difference of sizes, areas and volumes up to which two meshes are the same shape: formats round."""

FEW = 50
"""Faces below which shapes are alike by chance, as boxes are, unless name or folder speak for it too."""

SMALL = 0.02
"""Below this, metres or a share of a size, a difference counts as that of something so large."""

HANDED = 0.002
"""`Measured.handed` of both, together and of opposite signs, from which on they are a left one and a right one."""

ALIKE_COLOUR = 2.0
"""Mean difference of colours by place, of 255, up to which two meshes may be one: a picture in half its size, compressed
again as JPEG, differs by about 1."""

_TURNS = [
    (axes, flips)
    for axes in permutations(range(3))
    for flips in product((1, -1), repeat=3)
    if np.linalg.det(np.eye(3)[list(axes)] * flips) > 0
]
"""The 24 rotations that take axes to axes, as an order of axes and their directions."""


def find_doubles(items: Sequence[Item], size_m: Callable[[Item], float], formats: Sequence[str]) -> list[LeftOut]:
    """The items that are another one again: the same shape and size in metres, or in one folder the same shape.

    Two shapes are the same that have as many faces, and extents, area and volume alike in whatever order of axes; unless
    they are mirror images, or both have pictures, or neither has, and their colours differ where faces lie. One name in two
    formats needs no more than extents and area alike: readers drop faces, and some programs write other colours as linear
    light. That stays which has pictures, then colours, then the format that comes first in `formats`.
    """
    order = sorted(
        items,
        key=lambda one: (not one.measured.textures, one.measured.look is None, formats.index(one.suffix), one.path),
    )
    seen, left_out = dict[int | tuple[str, str], list[tuple[Item, str]]](), list[LeftOut]()
    for item in order:
        like = [seen.setdefault(key, []) for key in (item.measured.faces, home(item.path))]
        original = next((of for some in like for one, of in some if _is_double(item, one, size_m)), None)
        for some in like:
            some.append((item, original or item.path))
        if original is not None:
            left_out.append(LeftOut(item.path, COPY, f"double of {original}"))
    return left_out


def _is_double(item: Item, other: Item, size_m: Callable[[Item], float]) -> bool:
    if item.digest == other.digest:
        return True
    mine, theirs = item.measured, other.measured
    posed = (item.suffix in POSED) != (other.suffix in POSED)
    near = item.suffix != other.suffix and _nested(home(item.path)[0], home(other.path)[0], posed)
    same = near and _name(item) == _name(other)
    if mine.faces < FEW and not (same or (near and posed)):
        return False
    if mine.faces != theirs.faces and not same:
        return False
    ours, others = _shape(item), _shape(other)
    if same:  # empty faces are dropped, and the volume of an open shape is not of the shape alone
        ours, others = ours[:-1], others[:-1]
    pairs = zip(ours if near else (*ours, size_m(item)), others if near else (*others, size_m(other)), strict=True)
    if not all(abs(a - b) <= ALIKE * max(abs(a), abs(b), SMALL) for a, b in pairs):
        return False
    if not same and abs(mine.handed + theirs.handed) < 0.1 * abs(mine.handed - theirs.handed) > HANDED:
        return False
    if same or mine.look is None or theirs.look is None or bool(mine.textures) != bool(theirs.textures):
        return True
    return _differ(mine.look, theirs.look) <= ALIKE_COLOUR


def _differ(look: Sequence[float], other: Sequence[float]) -> float:
    """The mean difference of two `sample_look`, of 255, in that of `_TURNS` in which they are most alike."""
    one, two = (np.reshape(colours, (LOOK_SIDE, LOOK_SIDE, LOOK_SIDE, 3)) for colours in (look, other))
    turned = (two.transpose(*axes, 3)[tuple(slice(None, None, flip) for flip in flips)] for axes, flips in _TURNS)
    return min(float(np.abs(one - each).max(axis=-1).sum()) for each in turned)


def home(path: str) -> tuple[str, str]:
    """(the folder of a file, its name): the same of one thing in several formats, also where each has a folder of its own."""
    folders = (name for name in PurePosixPath(path).parts[:-1] if not _FORMAT.fullmatch(name))
    return "/".join(folders), _stem(path)


def _name(item: Item) -> str:
    return _stem(item.path).removeprefix("non")


def _nested(one: str, other: str, anywhere: bool) -> bool:
    """Whether two folders are the same, or one lies in the other; in the topmost one, `anywhere`, all others do."""
    above, below = sorted((one, other), key=len)
    return one == other or (bool(above) and below.startswith(f"{above}/")) or (anywhere and not above)


def _shape(item: Item) -> tuple[float, ...]:
    """What does not depend on unit and axes: extents in order, area and volume, by the diagonal."""
    size = item.diagonal
    extents = (extent / size for extent in sorted(item.measured.extents))
    return *extents, item.measured.area / size**2, item.measured.volume / size**3
