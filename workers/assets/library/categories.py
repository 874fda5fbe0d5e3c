"""Pure: the categories of a folder's objects, by where they lie and what they are called."""

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import PurePosixPath
from typing import TypeVar

from schemas.job.assets import LONGEST, LONGEST_BYTES, TABLE, is_letter, is_usable

BY_FOLDER, BY_FILE, BY_PARENT = "folder", "file", "parent"
"""The ways to name a category; any other word names them all."""

_GENERIC = re.compile(
    "mesh(es)?|models?|files?|objects?|assets?|data|visuals?|textured|collada|train|test|val|"
    r"(obj|stl|ply|glb|gltf|urdf|mjcf|sdf|dae|off|fbx|3d)( format| files)?",
    re.IGNORECASE,
)
"""Names of folders that say what files are, and not what things are."""

Names = TypeVar("Names", str, tuple[str, ...])
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


def _common_start(words: Sequence[Names]) -> Names:
    first, last = min(words), max(words)
    same = (k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b)
    return first[: next(same, min(len(first), len(last)))]
