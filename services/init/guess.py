"""Pure: what a job says about a folder of meshes: categories by pattern, units, and the axis that is up."""

import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from glob import escape
from pathlib import PurePosixPath
from statistics import median

from pydantic import TypeAdapter, ValidationError

from schemas.job.assets import CategoryName, UpAxis, matches
from services.init.collection import Item, Scale, UpRule

BY_FOLDER, BY_FILE = "folder", "file"
"""The ways to name a category; any other word names them all."""

LONGEST = 64
_NAME: TypeAdapter[str] = TypeAdapter(CategoryName)


def category_of(path: str, source: str | None) -> str:
    """The category of a file below the folder.

    `folder` and by default: the name of the first folder in its path; `file`, or where it lies in none: its own name
    without the number at the end. Any other `source` is the category itself.
    """
    if source not in (None, BY_FOLDER, BY_FILE):
        return str(source)
    first, *rest = path.split("/")
    if rest and source != BY_FILE:
        return usable_name(first)
    stem = PurePosixPath(path).stem
    return usable_name(re.sub(r"[\s_.-]*\d+$", "", stem) or stem)


def usable_name(text: str) -> str:
    """The text as the name of a category: other characters than letters, digits, - and _ become one -."""
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", text).strip("-_")[:LONGEST] or "object"
    if name.isdigit():
        name = f"n{name}"[:LONGEST]
    return name if is_category(name) else f"{name[: LONGEST - 5]}_mesh"  # a name that is taken


def is_category(name: str) -> bool:
    """Whether a category of objects may have this name."""
    try:
        _NAME.validate_python(name)
    except ValidationError:
        return False
    return True


def map_categories(items: Mapping[str, str], others: Collection[str], harmless: Collection[str]) -> dict[str, str]:
    """Category by pattern: together they find exactly the files of `items`, a category by path.

    `others` are further files of the folder, which no pattern finds, but for the `harmless` ones, which a job leaves out by
    itself.
    """
    everything = sorted({*items, *others})
    groups: dict[tuple[str, str], list[str]] = {}
    for path, category in items.items():
        groups.setdefault((category, PurePosixPath(path).suffix), []).append(path)
    found: dict[str, str] = {}
    for (category, _), paths in sorted(groups.items()):
        allowed = {*paths, *harmless} - (items.keys() - set(paths))
        found |= dict.fromkeys(_cover(sorted(paths), everything, allowed), category)
    return found


def _cover(paths: Sequence[str], everything: Iterable[str], allowed: Collection[str]) -> list[str]:
    """One pattern that finds all of the paths and otherwise only what is allowed; else a pattern for each."""
    if len(paths) > 1:
        start = _common_start(paths)
        folder = start[: start.rfind("/") + 1]
        near = [path for path in everything if path.startswith(folder)]
        for pattern in _patterns(paths, escape(folder)):
            hit = {path for path in near if matches(path, pattern)}
            if set(paths) <= hit <= set(allowed):
                return [pattern]
    return [escape(path) for path in paths]


def _patterns(paths: Sequence[str], folder: str) -> Iterator[str]:
    """Patterns below a folder that may find the paths, the plainest first."""
    suffix, names = escape(PurePosixPath(paths[0]).suffix), [PurePosixPath(path).name for path in paths]
    start = escape(_common_start([PurePosixPath(name).stem for name in names]))
    for between in ("", "*/", "**/"):
        if len(set(names)) == 1:
            yield f"{folder}{between}{escape(names[0])}"
        else:
            yield f"{folder}{between}*{suffix}"
            yield f"{folder}{between}{start}*{suffix}"
            yield f"{folder}{between}{start}*[0-9]{suffix}"


def _common_start(words: Sequence[str]) -> str:
    first, last = min(words), max(words)
    same = (k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b)
    return first[: next(same, min(len(first), len(last)))]


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
        whole = UpRule(f"**/*{escape(suffix)}", *_decide(group, suffix.lower()))
        formats.append(whole)
        for first in sorted({item.path.split("/")[0] for item in group if "/" in item.path}):
            axis, sure, told = _majority([item for item in group if item.path.startswith(f"{first}/")])
            if axis is not None and axis != whole.axis and sure > 1:
                pattern = f"{escape(first)}/**/*{escape(suffix)}"
                folders.append(UpRule(pattern, axis, f"{told}, unlike other {suffix} files"))
        for item in group:
            held = next((rule.axis for rule in folders if matches(item.path, rule.pattern)), whole.axis)
            if item.measured.confidence == "sure" and item.measured.up not in (None, held):
                assert item.measured.up is not None
                why = "stands on this axis alone, unlike its neighbours"
                files.append(UpRule(escape(item.path), item.measured.up, why))
    return [*files, *folders, *formats]


def plain_axis(rules: Sequence[UpRule]) -> UpAxis | None:
    """The axis that all rules name; None where they differ."""
    axes = {rule.axis for rule in rules}
    return axes.pop() if len(axes) == 1 else None


def _decide(items: Sequence[Item], suffix: str) -> tuple[UpAxis, str]:
    """The axis that is up in the files of one format, and why."""
    axis, _, told = _majority(items)
    if axis is not None:
        return axis, told
    if suffix in (".glb", ".gltf"):
        return "y", "by the format's specification; nothing in the shapes speaks against it"
    likely = Counter(item.measured.up for item in items if item.measured.up is not None)
    for found, count in likely.most_common(1):
        if count >= AGREE * likely.total():
            return found, f"likely: {count} of {len(items)} stand firmer so than upside down; look at the pictures"
    return "z", "not known: the shapes stand on several axes or on none; look at the pictures"


def _majority(items: Sequence[Item]) -> tuple[UpAxis | None, int, str]:
    """The axis that enough of those files name that are sure, None where none does; how many are sure; and the reason."""
    votes = Counter(item.measured.up for item in items if item.measured.confidence == "sure")
    axis, count = votes.most_common(1)[0] if votes else (None, 0)
    told = (
        f"sure: {count} of {len(items)} stand on this axis alone"
        if len(items) > 1
        else "sure: it stands on this axis alone"
    )
    return axis if count >= AGREE * votes.total() else None, votes.total(), told
