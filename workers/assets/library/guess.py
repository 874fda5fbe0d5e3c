"""Pure: of the files of a folder, their units and the axis that is up; and their categories, by folders and names."""

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import PurePosixPath
from statistics import median

from schemas.job.assets import LONGEST, LONGEST_BYTES, TABLE, UpAxis, is_letter, is_usable
from workers.assets.library.copies import ALIKE, FORMAT_FOLDER, Item, home
from workers.door.meshes.urdf import POSED

METRIC = frozenset({".glb", ".gltf", ".dae", *POSED})
"""Formats whose specification says metres."""

SPECIFIED_UP: Mapping[str, UpAxis] = {".glb": "y", ".gltf": "y", **dict.fromkeys(POSED, "z")}
"""Formats whose specification or use says which axis is up: believed, unless most of all files show that it is not."""


@dataclass(frozen=True)
class Group:
    """Files with one scale: `factor` to metres, or to `diagonal_m` where sizes are normalised.

    why: a line for each format.
    """

    paths: tuple[str, ...]
    factor: float
    why: tuple[str, ...]
    diagonal_m: float | None = None

    def unit(self, item: Item) -> float:
        """Metres in a unit of one of its files."""
        return self.factor if self.diagonal_m is None else self.diagonal_m / item.diagonal


UNITS = ((1.0, "metres"), (0.01, "centimetres"), (0.001, "millimetres"))
STATED = {**dict(UNITS), 0.0254: "inches", 0.3048: "feet"}

USUAL_M = 0.2
"""Size of a thing that stands on a table: of several units, the one that comes nearest is meant."""

BELIEVED_M, NOT_METRES, TOO_LARGE = 2.5, 0.5, 2.0
"""Up to this size metres are rather believed than another unit, which costs `NOT_METRES` as the logarithm of a size does;
beyond it nothing stands on a table, and each such unit of the logarithm costs so many more."""

SPLIT = 3.0
"""What it costs that a folder or file has another unit than the folder that it lies in."""

POSSIBLE_M = (0.001, 20.0)
"""Sizes at which a specification that says metres is believed."""
IMPOSSIBLE = 100.0

ON_TABLE_M = (0.01, 1.0)
"""Sizes of things on a table: what is smaller or larger is told."""

NORMALISED, SPREAD = (0.9, 2.0), 0.005
"""A size that shapes are normalised to, and by how much those of several may differ."""

AGREE = 2 / 3
"""Share of the files that tell which axis is up that must agree."""


def guess_groups(items: Sequence[Item], doubles: Sequence[Item] = ()) -> list[Group]:
    """The files by their scale, with the reasons of each format. doubles: what is one of them again, and tells of units too."""
    scales: dict[tuple[float, float | None], list[tuple[list[Item], str]]] = {}
    told = {item.path: number for item, _, number in _elsewhere([*items, *doubles])}
    for suffix in sorted({item.suffix for item in items}):
        mine, more = ([item for item in some if item.suffix == suffix] for some in (items, doubles))
        for factor, diagonal_m, some, why in _guess_scales(suffix, mine, more, told):
            scales.setdefault((factor, diagonal_m), []).append((some, why))
    return [
        Group(
            tuple(item.path for some, _ in of_scale for item in some),
            factor,
            tuple(why for _, why in of_scale),
            diagonal_m,
        )
        for (factor, diagonal_m), of_scale in scales.items()
    ]


def _elsewhere(items: Sequence[Item]) -> Iterator[tuple[Item, Item, int]]:
    """(item of a format without units, the same thing in one that says metres, number of the unit in which both are as large)."""
    metric = {home(item.path): item for item in items if item.suffix in METRIC and item.suffix not in POSED}
    for item in items:
        if item.suffix not in METRIC and item.measured.unit_m is None and (same := metric.get(home(item.path))):
            theirs = [(same.measured.unit_m or 1.0) * extent for extent in sorted(same.measured.extents)]
            for number, (unit, _) in enumerate(UNITS):
                if _alike([unit * extent for extent in sorted(item.measured.extents)], theirs):
                    yield item, same, number


def _alike(extents: Sequence[float], others: Sequence[float]) -> bool:
    return all(abs(a - b) <= ALIKE * max(others) for a, b in zip(extents, others, strict=True))


def _guess_scales(
    suffix: str, items: Sequence[Item], doubles: Sequence[Item], told: Mapping[str, int]
) -> list[tuple[float, float | None, list[Item], str]]:
    """Of the files of one format: scale, diagonal where sizes are normalised, the files that it holds for, and why."""
    scales = list[tuple[float, float | None, list[Item], str]]()
    for unit in sorted({item.measured.unit_m for item in items if item.measured.unit_m is not None}):
        some = [item for item in items if item.measured.unit_m == unit]
        scales.append((unit, None, some, f"{_told(suffix, some, items)}: {STATED[unit]}, as the files say"))
    rest = [item for item in items if item.measured.unit_m is None]
    sizes = [item.diagonal for item in rest]
    alike = (
        len(sizes) >= 3 and max(sizes) <= (1 + SPREAD) * min(sizes) and NORMALISED[0] < median(sizes) < NORMALISED[1]
    )
    if alike and suffix not in METRIC:
        why = f"{_told(suffix, rest, items)}, all alike, as shapes without a unit have it: resized to 0.25 m"
        return [*scales, (1.0, 0.25, rest, why)]
    known = [*rest, *(item for item in doubles if item.measured.unit_m is None)]
    units = _guess_units({item.path: item.diagonal for item in known}, suffix in METRIC, told)
    for number, (factor, name) in enumerate(UNITS):
        if some := [item for item in rest if units[item.path] == number]:
            scales.append((factor, None, some, f"{_told(suffix, some, items)}: {_reading(suffix, some, factor, name)}"))
    return scales


def _told(suffix: str, some: Sequence[Item], items: Sequence[Item]) -> str:
    """What files these are, of those of a format, and how large."""
    size = median(item.diagonal for item in some)
    folders = dict.fromkeys(str(PurePosixPath(item.path).parent) for item in some)
    where = f" in {', '.join(list(folders)[:3])}{' ...' * (len(folders) > 3)}" if len(some) < len(items) else ""
    return f"{suffix}{where}: {size:.3g} units across" + (" (the middle one)" if len(some) > 1 else "")


def _reading(suffix: str, items: Sequence[Item], factor: float, name: str) -> str:
    """The unit that is taken, and the other one that may be meant."""
    size, specified = median(item.diagonal for item in items), suffix in METRIC and factor == 1.0
    others = sorted((_cost(size, k, False), unit, word) for k, (unit, word) in enumerate(UNITS) if unit != factor)
    doubt = not specified or not ON_TABLE_M[0] <= size <= ON_TABLE_M[1]
    near = [(unit, word) for _, unit, word in others if ON_TABLE_M[0] <= size * unit <= ON_TABLE_M[1]]
    other = f" (as {near[0][1]}, {near[0][0]:g}, it would be {length(size * near[0][0])})" if near and doubt else ""
    return f"taken for {name}{', as the format says' if specified else ''}, {length(size * factor)}{other}"


def _cost(size: float, unit: int, specified: bool) -> float:
    """How unlikely it is that a thing of this size, in units of its file, has it in `UNITS[unit]`."""
    if specified and POSSIBLE_M[0] <= size <= POSSIBLE_M[1]:
        return IMPOSSIBLE * (unit != 0)
    metres = size * UNITS[unit][0]
    unusual = abs(math.log(metres / USUAL_M)) + TOO_LARGE * max(0.0, math.log(metres / BELIEVED_M))
    return unusual + NOT_METRES * (unit != 0) + IMPOSSIBLE * (specified and unit == 0)


@dataclass
class _Folder:
    """A folder, or a file, which has nothing below it: what each unit costs for all that lies in it."""

    below: "dict[str, _Folder]"
    costs: list[float]
    size: float = 0.0

    def finish(self) -> list[float]:
        """Sets and returns the costs, from what lies below: as its folder has it, or for `SPLIT` more as it likes best."""
        for folder in self.below.values():
            costs = folder.finish()
            self.costs = [sum_ + min(cost, min(costs) + SPLIT) for sum_, cost in zip(self.costs, costs, strict=True)]
        return self.costs

    def units(self, unit: int, path: str = "") -> dict[str, int]:
        """The number of the unit of every file below, where the folder above has `unit`.

        A file that leaves its folder's unit is judged by itself, and by the size of those that stay.
        """
        if self._leaves(unit):
            unit = self.costs.index(min(self.costs))
        if not self.below:
            return {path[1:]: unit}
        files = [part for part in self.below.values() if not part.below]
        usual = [math.log(part.size * UNITS[unit][0]) for part in files if not part._leaves(unit)] or [
            math.log(USUAL_M)
        ]
        chosen = dict[str, int]()
        for name, part in self.below.items():
            if not part.below and part._leaves(unit):
                apart = [abs(math.log(part.size * metres) - median(usual)) for metres, _ in UNITS]
                costs = [cost + far for cost, far in zip(part.costs, apart, strict=True)]
                chosen[f"{path}/{name}"[1:]] = costs.index(min(costs))
            else:
                chosen |= part.units(unit, f"{path}/{name}")
        return chosen

    def _leaves(self, unit: int) -> bool:
        return self.costs[unit] > min(self.costs) + SPLIT


def _guess_units(sizes: Mapping[str, float], specified: bool, told: Mapping[str, int]) -> dict[str, int]:
    """For each file the number of its unit in `UNITS`: that which is told, or the cheapest that is the same for neighbours.

    A folder has one unit, unless what lies in it says another by more than `SPLIT`; so do its own folders.
    """
    root = _Folder({}, [0.0] * len(UNITS))
    for path, size in sizes.items():
        at = root
        for name in path.split("/"):
            at = at.below.setdefault(name, _Folder({}, [0.0] * len(UNITS)))
        at.size = size
        at.costs = [_cost(size, unit, specified) for unit in range(len(UNITS))]
        if path in told:
            at.costs = [IMPOSSIBLE * (unit != told[path]) for unit in range(len(UNITS))]
    costs = root.finish()
    return root.units(costs.index(min(costs))) if sizes else {}


def length(metres: float) -> str:
    """A length in the unit that people use."""
    unit, name = next(((u, n) for u, n in ((1.0, "m"), (0.01, "cm")) if metres >= u), (0.001, "mm"))
    return f"{metres / unit:.3g} {name}"


def guess_ups(items: Sequence[Item], doubles: Sequence[Item] = ()) -> dict[str, tuple[UpAxis, str]]:
    """For each file the axis that is up, and why: what it says itself, what its first folder shows, or its whole format.

    doubles: what is one of them again. Where the same things are there in a format whose axis is known, their extents tell it.
    """
    ups = _ups_elsewhere(items, [*items, *doubles])
    rest = [item for item in items if item.path not in ups]
    for suffix in sorted({item.suffix for item in rest}):
        group = [item for item in rest if item.suffix == suffix]
        stated = Counter(item.measured.stated_up for item in group).most_common(1)[0][0]
        specified = stated or SPECIFIED_UP.get(suffix)
        odd = [item for item in group if item.measured.stated_up != stated]
        ups |= {item.path: (item.measured.stated_up or "y", "as the file says") for item in odd}
        group = [item for item in group if item not in odd]
        whole = _decide(group, specified)
        ups |= {item.path: whole for item in group}
        for first in sorted({item.path.split("/")[0] for item in group if "/" in item.path}):
            inside = [item for item in group if item.path.startswith(f"{first}/")]
            axis, count, message = _majority(inside, specified)
            if axis is not None and axis != whole[0] and count > (1 if specified is None else 2):
                ups |= {item.path: (axis, f"{message}, unlike other {suffix} files") for item in inside}
        for item in group if not stated and specified != "y" else ():  # in robots' files z is up by use alone
            sure = item.measured.sure_of(specified)
            if sure is not None and sure != ups[item.path][0]:
                ups[item.path] = sure, "stands on this axis alone, unlike its neighbours"
    return ups


def _ups_elsewhere(items: Sequence[Item], every: Sequence[Item]) -> dict[str, tuple[UpAxis, str]]:
    """As `guess_ups`, of items that lie where most of the same things in another format show one axis; every: with doubles."""
    votes = dict[tuple[str, str], Counter[UpAxis]]()
    for item, same, _ in _elsewhere(every):
        (x, y, z), factor = same.measured.extents, same.diagonal / item.diagonal
        ours = [factor * extent for extent in item.measured.extents]
        known: tuple[tuple[UpAxis, Sequence[float]], ...] = ("y", (x, y, z)), ("z", (x, z, y))
        shown = [up for up, theirs in known if _alike(ours, theirs)]
        if SPECIFIED_UP.get(same.suffix) == "y" and same.measured.stated_up is None and len(shown) == 1:
            votes.setdefault((item.suffix, home(item.path)[0]), Counter())[shown[0]] += 1
    most = {place: (counts.most_common(1)[0], counts.total()) for place, counts in votes.items()}
    shown_in = {
        place: (axis, f"as {count} of the same things in another format")
        for place, ((axis, count), total) in most.items()
        if count >= AGREE * total
    }
    places = {item.path: (item.suffix, home(item.path)[0]) for item in items}
    return {path: shown_in[place] for path, place in places.items() if place in shown_in}


def _decide(items: Sequence[Item], specified: UpAxis | None) -> tuple[UpAxis, str]:
    """The axis that is up in the files of one format, and why."""
    axis, count, message = _majority(items, specified)
    if axis is not None:
        return axis, message
    if specified is not None:
        against = sum(item.measured.sure_of(specified) not in (None, specified) for item in items)
        return specified, "by the format's specification" + (
            f", though {against} of {len(items)} stand on another axis alone: look at the pictures"
            if against
            else "; nothing in the shapes speaks against it"
        )
    likely = Counter(item.measured.up for item in items if item.measured.up is not None)
    for up, count in likely.most_common(1):
        if count >= AGREE * likely.total():
            return (
                up,
                f"likely: {count} of {len(items)} stand firmer so than upside down; look at the pictures",
            )
    return "z", "not known: the shapes stand on several axes or on none; look at the pictures"


def _majority(items: Sequence[Item], specified: UpAxis | None) -> tuple[UpAxis | None, int, str]:
    """The axis that enough files are sure of, None where none is; how many are sure of it or of another; and the reason.

    Enough are most of those that are sure; against a specification, most of all files.
    """
    votes = Counter(axis for item in items if (axis := item.measured.sure_of(specified)) is not None)
    axis, count = votes.most_common(1)[0] if votes else (None, 0)
    message = (
        f"sure: {count} of {len(items)} stand on {'this axis' if specified is None else axis} alone"
        if len(items) > 1
        else "sure: it stands on this axis alone"
    )
    enough = count >= AGREE * votes.total() if specified in (None, axis) else 2 * count > len(items)
    return axis if enough else None, votes.total(), message


# ---------------------------------------------------------------------------------------------- categories

BY_FOLDER, BY_FILE, BY_PARENT = "folder", "file", "parent"
"""The ways to name a category; any other word names them all."""

_GENERIC = re.compile(
    f"mesh(es)?|models?|files?|objects?|assets?|data|visuals?|textured|collada|train|test|val|{FORMAT_FOLDER}",
    re.IGNORECASE,
)
"""Names of folders that say what files are, and not what things are."""

_NUMBER = re.compile(r"[\s_.-]*\d+$")
_IDENTIFIER = re.compile(r"[\d_.-]+|(?=.*\d)[0-9a-f-]{6,}|(?=.*\d)[A-Z0-9]{8,}")
"""A name that a database gave: digits, hexadecimal digits, or capitals and digits."""


def name_categories(paths: Iterable[str], source: str | None) -> dict[str, str]:
    """The category of each object, by its path below the folder.

    `folder`: the first folder in its path that not all share; `parent`: the folder that it lies in; `file`: its own name
    without the number at its end. Any other `source` is the category itself. By default the name of the folder that holds it
    alone, where no object lies beside that folder; else of the first one in its path in which objects lie. Of a folder whose
    name says nothing (`meshes`, an identifier) that above it; where none says something, the file. A number at the end that
    tells several apart goes.
    """
    if source not in (None, BY_FOLDER, BY_FILE, BY_PARENT):
        return dict.fromkeys(paths, str(source))
    return {path: usable_name(word) for path, word in _words_of(paths, source).items()}


def find_joined(paths: Iterable[str], source: str | None) -> dict[str, str]:
    """By category, the different names that became one, in a phrase."""
    joined: dict[str, set[str]] = {}
    for word in _words_of(paths, source).values():
        joined.setdefault(usable_name(word), set()).add(word)
    return {
        name: f"category {name} is of {', '.join(map(repr, sorted(words)))}"
        for name, words in joined.items()
        if len(words) > 1
    }


def _words_of(paths: Iterable[str], source: str | None) -> dict[str, str]:
    """What names the category of each path, as it is written."""
    folders = {path: PurePosixPath(path).parts[:-1] for path in paths}
    if source not in (None, BY_FOLDER, BY_FILE, BY_PARENT):
        return dict.fromkeys(folders, str(source))
    levels = takewhile(lambda names: len(set(names)) == 1, zip(*folders.values(), strict=False))
    shared = len(list(levels)) if len(folders) > 1 else 0
    direct = set(folders.values())
    held = Counter(above[:depth] for above in folders.values() for depth in range(1, len(above) + 1))
    words = {}
    for path, above in folders.items():
        stem = PurePosixPath(path).stem
        of_file = _NUMBER.sub("", stem) or stem
        if not above or source == BY_FILE:
            words[path] = of_file
        elif source is not None:
            words[path] = above[-1 if source == BY_PARENT else min(shared, len(above) - 1)]
        else:
            alone = next((k for k in range(shared + 1, len(above) + 1) if held[above[:k]] == 1), 0)
            if alone and alone != shared + 1 and above[: alone - 1] in direct:
                alone = 0
            depth = alone or next((k for k in range(shared + 1, len(above) + 1) if above[:k] in direct), shared)
            rest = [*above[:shared][::-1], of_file] if alone else [of_file, *above[:shared][::-1]]
            words[path] = next(filter(_says, [*above[shared:depth][::-1], *rest]), of_file)
    stems = {word: _NUMBER.sub("", word) or word for word in set(words.values())}
    series = Counter(stems.values())
    return {path: stems[word] if series[stems[word]] > 1 else word for path, word in words.items()}


def _says(name: str) -> bool:
    """Whether a name says what a thing is."""
    return not _GENERIC.fullmatch(name) and not _IDENTIFIER.fullmatch(name)


def usable_name(text: str) -> str:
    """The text as the name of a category: what is no letter or digit of any script, - or _ becomes one -."""
    text = "".join(c if is_letter(c) or c == "_" else "-" for c in unicodedata.normalize("NFC", text))
    name = re.sub("-+", "-", text).strip("-_")[:LONGEST].rstrip("-_")
    while len(name.encode()) > LONGEST_BYTES:
        name = name[:-1]
    name = name.lstrip("".join(c for c in name if not c.isalnum())) or "object"
    if name.isdigit():
        name = f"n{name}"[:LONGEST]
    return name if is_usable(name) and name.lower() != TABLE else f"{name[: LONGEST - 5]}_mesh"  # a name that is taken
