"""Pure: the unit of a folder's meshes and the axis that is up, guessed from their sizes and from how they stand."""

import math
from collections import Counter
from collections.abc import Sequence
from glob import escape
from pathlib import PurePosixPath
from statistics import median

from schemas.job.assets import UpAxis
from schemas.job.pattern import matches
from services.init.model import Item, Scale, UpRule

METRIC = frozenset({".glb", ".gltf", ".urdf"})
"""Formats whose specification says metres."""

UNITS = ((1.0, "metres"), (0.01, "centimetres"), (0.001, "millimetres"))

USUAL_M = 0.2
"""Size of a thing that stands on a table: of several units, the one that comes nearest is meant."""

PLAUSIBLE_M = (0.01, 2.5)
"""Sizes at which metres are not doubted."""

NORMALISED, SPREAD = (0.9, 2.0), 0.005
"""A size that shapes are normalised to, and by how much those of several may differ."""

AGREE = 2 / 3
"""Share of the files that tell which axis is up that must agree."""


def guess_scales(items: Sequence[Item]) -> list[Scale]:
    """A scale for each group of formats that have the same one."""
    found: dict[tuple[float, float | None], list[tuple[str, str]]] = {}
    for suffix in sorted({item.suffix for item in items}):
        scale = _guess_scale(suffix, [item.diagonal for item in items if item.suffix == suffix])
        found.setdefault((scale.factor, scale.diagonal_m), []).append((suffix, scale.why))
    return [
        Scale(tuple(suffix for suffix, _ in told), factor, "; ".join(why for _, why in told), diagonal_m)
        for (factor, diagonal_m), told in found.items()
    ]


def _guess_scale(suffix: str, diagonals: Sequence[float]) -> Scale:
    size = median(diagonals)
    told = f"{suffix}: {size:.3g} units across" + (" (the middle one)" if len(diagonals) > 1 else "")
    low, high = PLAUSIBLE_M
    if len(diagonals) >= 3 and max(diagonals) <= (1 + SPREAD) * min(diagonals) and NORMALISED[0] < size < NORMALISED[1]:
        return Scale((suffix,), 1.0, f"{told}, all alike, as shapes without a unit have it: resized to 0.25 m", 0.25)
    if low <= size <= high:
        by = ", as the format says" if suffix in METRIC else ""
        return Scale((suffix,), 1.0, f"{told}: taken for metres{by}")
    by_distance = sorted(UNITS, key=lambda unit: abs(math.log(size * unit[0] / USUAL_M)))
    factor, unit = by_distance[0]
    told += f": taken for {unit}, {_length(size * factor)}"
    if factor == 1.0:
        return Scale((suffix,), 1.0, f"{told}, which is very small: look at it")
    other, name = by_distance[1]
    if low <= size * other <= high:
        told += f" (as {name}, {other:g}, it would be {_length(size * other)})"
    return Scale((suffix,), factor, told)


def _length(metres: float) -> str:
    return f"{100 * metres:.3g} cm" if metres < 1 else f"{metres:.3g} m"


def guess_ups(items: Sequence[Item]) -> list[UpRule]:
    """Rules by pattern, the first that matches holds: of single files, of first folders, and of each format at the end."""
    files, folders, formats = list[UpRule](), list[UpRule](), list[UpRule]()
    for suffix in sorted({PurePosixPath(item.path).suffix for item in items}):
        group = [item for item in items if item.path.endswith(suffix)]
        whole = _decide(group, suffix.lower())
        formats.append(UpRule(f"**/*{escape(suffix)}", *whole))
        for first in sorted({item.path.split("/")[0] for item in group if "/" in item.path}):
            inside = [item for item in group if item.path.startswith(f"{first}/")]
            axis = _majority(inside)
            if axis not in (None, whole[0]) and len(_sure(inside)) > 1:
                assert axis is not None
                told = f"{_told(inside, axis)}, unlike other {suffix} files"
                folders.append(UpRule(f"{escape(first)}/**/*{escape(suffix)}", axis, told))
        for item in _sure(group):
            held = next((rule.axis for rule in folders if matches(item.path, rule.pattern)), whole[0])
            if item.measured.up not in (None, held):
                assert item.measured.up is not None
                files.append(
                    UpRule(escape(item.path), item.measured.up, "stands on this axis alone, unlike its neighbours")
                )
    return [*files, *folders, *formats]


def plain_axis(rules: Sequence[UpRule]) -> UpAxis | None:
    """The axis that all rules name; None where they differ."""
    axes = {rule.axis for rule in rules}
    return axes.pop() if len(axes) == 1 else None


def _decide(items: Sequence[Item], suffix: str) -> tuple[UpAxis, str]:
    """The axis that is up in the files of one format, and why."""
    axis = _majority(items)
    if axis is not None:
        return axis, _told(items, axis)
    if suffix in (".glb", ".gltf"):
        return "y", "by the format's specification; nothing in the shapes speaks against it"
    likely = Counter(item.measured.up for item in items if item.measured.up is not None)
    if likely:
        found, count = likely.most_common(1)[0]
        if found is not None and count >= AGREE * likely.total():
            return found, f"likely: {count} of {len(items)} stand firmer so than upside down; look at the pictures"
    return "z", "not known: the shapes stand on several axes or on none; look at the pictures"


def _sure(items: Sequence[Item]) -> list[Item]:
    return [item for item in items if item.measured.confidence == "sure"]


def _majority(items: Sequence[Item]) -> UpAxis | None:
    """The axis that enough of those files name that are sure; None where none does."""
    votes = Counter(item.measured.up for item in _sure(items))
    axis, count = votes.most_common(1)[0] if votes else (None, 0)
    return axis if count >= AGREE * votes.total() else None


def _told(items: Sequence[Item], axis: UpAxis) -> str:
    count = sum(item.measured.up == axis for item in _sure(items))
    return (
        f"sure: {count} of {len(items)} stand on this axis alone"
        if len(items) > 1
        else "sure: it stands on this axis alone"
    )
