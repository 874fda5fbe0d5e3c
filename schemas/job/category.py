"""Categories: the table of the built-in ones, what a user may call others, and which ones the sources of a job offer.

A new built-in category is a file in workers/assets/builtin with a function that makes a `Model` from a numpy generator, and a row
of `BUILT_IN`. Everything else follows: job, catalogue, ShapeNetCore, messages, tests.
"""

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from schemas.nearest import did_you_mean

TABLE = "table"
"""The category of tables, in `category_map` and in the tables of a dataset."""


@dataclass(frozen=True)
class Category:
    """A category that has built-in shapes.

    generator: `module:function` of what makes one, below workers.assets.builtin, named and not imported because schemas load
    nothing heavy. number: its place in a shape's seed; rows are numbered as they were added, and a number never changes.
    synset: the folder of ShapeNetCore with the same kind of thing, None where ShapeNetCore has none.
    """

    name: str
    number: int
    generator: str
    synset: str | None


BUILT_IN: Mapping[str, Category] = {
    row.name: row
    for row in (
        Category("bottle", 0, "bottle:make_bottle", "02876657"),
        Category("camera", 1, "camera:make_camera", "02942699"),
        Category("can", 2, "can:make_can", "02946921"),
        Category("jar", 3, "jar:make_jar", "03593526"),
        Category("laptop", 4, "laptop:make_laptop", "03642806"),
        Category("mug", 5, "crockery:make_mug", "03797390"),
        Category("bowl", 6, "crockery:make_bowl", "02880940"),
        Category("box", 7, "box:make_box", None),
        Category(TABLE, 8, "table:make_table", "04379243"),
    )
}
"""The built-in categories by name."""

CATEGORIES = tuple(name for name in BUILT_IN if name != TABLE)
"""The built-in categories of objects; the first eight are the article's."""

IN_SHAPENET = tuple(name for name in CATEGORIES if BUILT_IN[name].synset)
"""Those of them that ShapeNetCore has."""

VERSION = 2
"""Version of the built-in shapes, part of a catalogue's digest: raise it with every change to a vertex or colour."""


def instance_id(category: str, seed: int, index: int) -> str:
    """`mug-0-000123`: a built-in instance by category, seed, and the index in six digits, so that ids sort."""
    return f"{category}-{seed}-{index:06d}"


MOST_TOLD = 20
"""Categories that a message names."""

_ALLOWED = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")

_TAKEN = frozenset({"assets", "manifest"})
"""Names of a dataset's own folders."""


def _usable(name: str) -> str:
    if not _ALLOWED.fullmatch(name):
        raise ValueError(
            "a category is 1 to 64 letters, digits, - and _, the first a letter or digit: it names a folder"
        )
    if name.lower() in _TAKEN:
        raise ValueError("a dataset has a folder of this name: choose another")
    if name.isdigit():
        raise ValueError(
            f"digits alone would be read as a number by those who query the dataset: write a letter too, such as n{name}"
        )
    return name


def _of_objects(name: str) -> str:
    if name.lower() == TABLE:
        raise ValueError("the name of what objects stand on: choose another")
    return _usable(name)


CategoryName = Annotated[str, Field(max_length=1000), AfterValidator(_of_objects)]
"""A category of objects: any name that can be a folder's."""

MappedName = Annotated[str, Field(max_length=1000), AfterValidator(_usable)]
"""The same, or `table`."""


def offered_by(sources: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """The categories that sources of objects offer by their keys as a job file has them, the built-in ones first.

    Nothing of a source of files without a `category_map`. What is malformed is skipped: it is refused elsewhere.
    """
    names: dict[str, None] = {}
    for source in sources:
        kind, mapped = source.get("source"), source.get("category_map")
        names |= dict.fromkeys({"procedural": CATEGORIES, "shapenet": IN_SHAPENET}.get(str(kind), ()))
        if kind == "urdf" and isinstance(mapped, dict):
            names |= dict.fromkeys(name for name in mapped.values() if isinstance(name, str) and name != TABLE)
    return tuple(names)


def with_categories(tree: dict[str, Any]) -> dict[str, Any]:
    """The keys of a job with `categories`: where there are none, all that its sources offer, with equal weights."""
    if "categories" in tree:
        return tree
    return {**tree, "categories": dict.fromkeys(offered_by(_sources(tree)) or CATEGORIES, 1.0)}


def _sources(tree: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    assets = tree.get("assets")
    found = assets.get("objects") if isinstance(assets, dict) else None
    sources = found if isinstance(found, list) else [{"source": "procedural"}]
    return [source for source in sources if isinstance(source, dict)]


def describe_unknown(names: Iterable[str], offered: Sequence[str]) -> str:
    """What is wrong with names that no source offers, with the nearest one that some source does; empty where all are known."""
    some = tuple(itertools.islice(offered, MOST_TOLD))
    known = dict.fromkeys((*offered, *CATEGORIES))
    for name in names:
        if name not in known:
            return (
                f"categories.{name}: no source offers it; {did_you_mean(name, known)}offered: {', '.join(some)}. A source of "
                "files offers what its category_map names"
            )
    return ""
