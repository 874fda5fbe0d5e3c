"""Pure: the categories of a folder's objects, by where they lie and what they are called, and the patterns that say so."""

import re
import unicodedata
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from glob import escape
from pathlib import PurePosixPath
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from schemas.job.assets import LONGEST, LONGEST_BYTES, CategoryName, is_letter, matches

BY_FOLDER, BY_FILE, BY_PARENT = "folder", "file", "parent"
"""The ways to name a category; any other word names them all."""

_GENERIC = re.compile(
    "mesh(es)?|models?|files?|objects?|assets?|data|visuals?|textured|collada|train|test|val|"
    r"(obj|stl|ply|glb|gltf|urdf|mjcf|sdf|dae|off|fbx|3d)( format| files)?",
    re.IGNORECASE,
)
"""Names of folders that say what files are, and not what things are."""

Names = TypeVar("Names", str, tuple[str, ...])
_NAME: TypeAdapter[str] = TypeAdapter(CategoryName)
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
    folders = {path: PurePosixPath(path).parts[:-1] for path in paths}
    if source not in (None, BY_FOLDER, BY_FILE, BY_PARENT):
        return dict.fromkeys(folders, str(source))
    shared = len(_common_start(list(folders.values()))) if len(folders) > 1 else 0
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
    return {path: usable_name(stems[word] if series[stems[word]] > 1 else word) for path, word in words.items()}


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


def _common_start(words: Sequence[Names]) -> Names:
    first, last = min(words), max(words)
    same = (k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b)
    return first[: next(same, min(len(first), len(last)))]
