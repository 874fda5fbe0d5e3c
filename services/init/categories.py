"""Pure: the category of each file of a folder, from where it lies, and patterns that find the files of a category."""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from glob import escape
from pathlib import PurePosixPath

from pydantic import TypeAdapter, ValidationError

from schemas.job.category import CategoryName
from schemas.job.pattern import matches

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
        wanted, near = set(paths), _below(_common_folder(paths), everything)
        for pattern in _patterns(paths):
            hit = {path for path in near if matches(path, pattern)}
            if wanted <= hit and hit <= set(allowed):
                return [pattern]
    return [escape(path) for path in paths]


def _patterns(paths: Sequence[str]) -> Iterator[str]:
    """Patterns that may find the paths, the plainest first."""
    folder, suffix = escape(_common_folder(paths)), escape(PurePosixPath(paths[0]).suffix)
    names = [PurePosixPath(path).name for path in paths]
    start = escape(_common_start([PurePosixPath(name).stem for name in names]))
    for between in ("", "*/", "**/"):
        if len(set(names)) == 1:
            yield f"{folder}{between}{escape(names[0])}"
        else:
            yield f"{folder}{between}*{suffix}"
            yield f"{folder}{between}{start}*{suffix}"
            yield f"{folder}{between}{start}*[0-9]{suffix}"


def _common_folder(paths: Sequence[str]) -> str:
    """The folder that all paths lie in, with a slash at its end; empty for the uppermost."""
    start = _common_start(paths)
    return start[: start.rfind("/") + 1]


def _common_start(words: Sequence[str]) -> str:
    first, last = min(words), max(words)
    same = (k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b)
    return first[: next(same, min(len(first), len(last)))]


def _below(folder: str, paths: Iterable[str]) -> list[str]:
    return [path for path in paths if path.startswith(folder)]
