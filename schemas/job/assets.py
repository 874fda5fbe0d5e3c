"""The `assets` branch of a job, the names of categories, and patterns of file names."""

import hashlib
import itertools
import math
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field, Tag, field_validator, model_validator

from schemas.base import Folder, Frozen, Positive, PositiveInt, Seed, Share, Weight, among_kinds
from schemas.errors import did_you_mean

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
        Category("bottle", 0, "closed_vessels:make_bottle", "02876657"),
        Category("camera", 1, "camera:make_camera", "02942699"),
        Category("can", 2, "closed_vessels:make_can", "02946921"),
        Category("jar", 3, "open_vessels:make_jar", "03593526"),
        Category("laptop", 4, "laptop:make_laptop", "03642806"),
        Category("mug", 5, "open_vessels:make_mug", "03797390"),
        Category("bowl", 6, "open_vessels:make_bowl", "02880940"),
        Category("box", 7, "box:make_box", None),
        Category(TABLE, 8, "table:make_table", "04379243"),
        Category("tray", 9, "table:make_tray", None),
        Category("bin", 10, "table:make_bin", None),
    )
}
"""The built-in categories by name."""

TableKind = Literal["table", "tray", "bin"]
"""What a built-in table is; each is a row of `BUILT_IN`."""

TABLE_KINDS: tuple[str, ...] = get_args(TableKind)

CATEGORIES = tuple(name for name in BUILT_IN if name not in TABLE_KINDS)
"""The built-in categories of objects; the first eight are the article's."""

VERSION = 3
"""Version of the built-in shapes, part of a catalogue's digest: raise it with every change to a vertex or colour."""


def instance_id(category: str, seed: int, index: int) -> str:
    """`mug-0-000123`: a built-in instance by category, seed, and the index in six digits, so that ids sort."""
    return f"{category}-{seed}-{index:06d}"


MOST_TOLD = 20
"""Categories that a message names."""

LONGEST, LONGEST_BYTES = 64, 200
"""Letters of a category, and bytes of them in UTF-8: a file system allows 255 for a name."""

_TAKEN = frozenset({"assets", "manifest"})
"""Names of a dataset's own folders."""


def is_letter(c: str) -> bool:
    """Whether a character is a letter, a mark on one, or a digit, of any script."""
    return unicodedata.category(c)[0] in "LMN"


def _usable(name: str) -> str:
    letters = all(is_letter(c) or c in "-_" for c in name) and name[:1].isalnum()
    if not letters or len(name) > LONGEST or len(name.encode()) > LONGEST_BYTES:
        raise ValueError(
            f"a category is 1 to {LONGEST} letters, digits, - and _, the first a letter or digit: it names a folder"
        )
    if unicodedata.normalize("NFC", name) != name:
        raise ValueError("write its letters composed (Unicode NFC): file systems differ on others")
    if name.lower() in _TAKEN:
        raise ValueError("a dataset has a folder of this name: choose another")
    if name.isdigit():
        remedy = f"write a letter too, such as n{name}"
        raise ValueError(f"digits alone would be read as a number by those who query the dataset: {remedy}")
    return name


def _of_objects(name: str) -> str:
    if name.lower() == TABLE:
        raise ValueError("the name of what objects stand on: choose another")
    return _usable(name)


CategoryName = Annotated[str, Field(max_length=1000), AfterValidator(_of_objects)]
"""A category of objects: any name that can be a folder's."""


def _equal_weights(value: object) -> object:
    """A list of names as names with equal weights."""
    if not isinstance(value, list):
        return value
    if not all(isinstance(name, str) for name in value):
        raise ValueError("must be a list of names, or names with weights")
    if len(set(value)) != len(value):
        raise ValueError("names a category twice")
    return dict.fromkeys(value, 1.0)


CategoryWeights = Annotated[dict[CategoryName, Weight], BeforeValidator(_equal_weights)]
"""Categories with their weights; a list gives equal weights."""

SurfaceName = Annotated[
    str, Field(max_length=1000), AfterValidator(lambda name: name if name == TABLE else _of_objects(name))
]
"""What objects may touch: a category of objects, or the table, of whatever kind."""


def is_usable(name: str) -> bool:
    """Whether a category may have this name."""
    try:
        _usable(name)
    except ValueError:
        return False
    return True


def offered_by(sources: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """The categories that sources of objects are known to offer by their keys alone: those of built-in shapes, or none."""
    return CATEGORIES if any(source.get("source") == "procedural" for source in sources) else ()


def with_categories(tree: dict[str, Any]) -> dict[str, Any]:
    """The keys of a job with `categories`: where there are none, all that its sources offer, with equal weights."""
    if "categories" in tree:
        return tree
    return {**tree, "categories": dict.fromkeys(offered_by(sources_of(tree)) or CATEGORIES, 1.0)}


def sources_of(tree: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The sources of objects in the keys of a job, of which any may be missing or wrong."""
    assets = tree.get("assets")
    listed = assets.get("objects") if isinstance(assets, Mapping) else None
    sources = listed if isinstance(listed, list) else [{"source": "procedural"}]
    return [source for source in sources if isinstance(source, Mapping)]


def describe_unknown(names: Iterable[str], offered: Sequence[str], key: str = "categories") -> str:
    """What is wrong with names, of a key, that no source offers, with the nearest that one does; empty where all are known."""
    some = tuple(itertools.islice(offered, MOST_TOLD))
    known = dict.fromkeys((*offered, *CATEGORIES))
    for name in names:
        if name not in known:
            return (
                f"{key}.{name}: no source offers it; {did_you_mean(name, known)}offered: {', '.join(some)}. A library "
                "offers what its table names"
            )
    return ""


UpAxis = Literal["x", "y", "z"]
"""An axis of a file."""


class ProceduralSource(Frozen):
    """The built-in shapes, made from a seed."""

    source: Literal["procedural"]
    """Which kind of source this is."""
    weight: Weight = 1.0
    """Share among the sources that offer a scene's category."""
    seed: Seed = 0
    """Seed of the shapes; instance n of a category is the same in every dataset with this seed."""
    instances: Annotated[int, Field(ge=1, le=10**12)] = 1_000_000
    """Distinct instances of each category; up to 10,000 are kept once made."""
    size: Literal["article", "metric"] = "article"
    """`article`: bounding-box diagonal `diagonal_m`; `metric`: the true size of such an object. Tables are metric."""
    diagonal_m: Positive = 0.25
    """Bounding-box diagonal for `size: article`."""
    kind: TableKind = "table"
    """Of tables: a tray has a rim of 2 to 6 cm, a bin walls of 12 to 26 cm."""

    def named(self, category: str) -> str:
        """The row of `BUILT_IN` that makes its instances of a category."""
        return self.kind if category == TABLE else category


class LibrarySource(Frozen):
    """A library of shapes that `verso init` made, or a folder of which a run makes one in the user's cache."""

    source: Literal["library"]
    """Which kind of source this is."""
    weight: Weight = 1.0
    """Share among the sources that offer a scene's category."""
    folder: Folder
    """A library, or a folder of meshes, URDFs or ShapeNetCore models, relative to the job file; `pybullet_data`: the meshes of
    that package."""
    diagonal_m: Positive | None = None
    """Bounding-box diagonal of every object; without it each keeps its own size."""
    copy_assets: bool = False
    """Whether the shapes may be written into the dataset."""


Source = Annotated[ProceduralSource | LibrarySource, Field(discriminator="source")]
SOURCE_KINDS = ("procedural", "library")


Split = Literal["train", "val", "test", "unseen"]
"""What instances are for; `unseen` are those of categories that nothing is trained on."""

SPLITS: tuple[str, ...] = get_args(Split)
"""From the laxest to the strictest."""

NO_SPLIT = "none"
"""The split of an instance that `assets.split.named` does not name."""


class SplitShares(Frozen):
    """Shares of instances (not of scenes) in train, val and test, or the instances themselves."""

    train: Share = 0.8
    """Share of train."""
    val: Share = 0.1
    """Share of val."""
    test: Share = 0.1
    """Share of test."""
    named: dict[Split, tuple[str, ...]] = Field(default_factory=dict)
    """Instead of shares: the instances of train, val, test and unseen by their ids, in which * stands for anything. The objects
    of a scene are then all of one split, and no scene has an instance that is not named."""

    @field_validator("named")
    @classmethod
    def _named_once(cls, named: dict[Split, tuple[str, ...]]) -> dict[Split, tuple[str, ...]]:
        names = Counter(itertools.chain.from_iterable(named.values()))
        if twice := [name for name, count in names.items() if count > 1]:
            raise ValueError(f"names {twice[0]} twice: an instance is in one split")
        return named

    @model_validator(mode="after")
    def _sums_to_one(self) -> "SplitShares":
        total = self.train + self.val + self.test
        if not math.isclose(total, 1.0, abs_tol=1e-9):
            raise ValueError(f"train + val + test is {total:g}, and must be 1")
        return self

    def of(self, instance: str) -> str:
        """`train`, `val` or `test` by the hash of the instance's id: all scenes of an instance fall into one split.

        With `named` the split that names it, by the id itself before any pattern; `NO_SPLIT` where none does.
        """
        if self.named:
            by_id = (split for split, names in self.named.items() if instance in names)
            alike = (s for s, names in self.named.items() if any("*" in n and fnmatchcase(instance, n) for n in names))
            return next(itertools.chain(by_id, alike), NO_SPLIT)
        place = int.from_bytes(hashlib.sha256(instance.encode()).digest()[:8], "big") / 2.0**64
        return "train" if place < self.train else "val" if place < self.train + self.val else "test"


class MeshLimits(Frozen):
    """Caps on meshes from outside, which `verso init --limit` changes: one that is over a cap is left out and counted."""

    max_file_mb: Positive = 256.0
    """Largest mesh file, MB."""
    max_vertices: PositiveInt = 5_000_000
    """Most vertices."""
    max_faces: PositiveInt = 5_000_000
    """Most faces."""
    max_texture_px: PositiveInt = 8192
    """Longest side of a texture, pixels."""
    max_textures_mpx: Positive = 128.0
    """Most pixels, millions, of all textures of an asset; those beyond are left out."""
    max_asset_mb: Positive = 512.0
    """Most bytes, MB, of a mesh or URDF and all files that it refers to."""
    max_nodes: PositiveInt = 4096
    """Most parts, files, nodes, links, joints or visuals of an asset."""
    min_size_m: Positive = 0.001
    """Smallest bounding-box diagonal, metres, after scaling."""
    max_size_m: Positive = 20.0
    """Largest bounding-box diagonal, metres, after scaling."""
    max_cpu_s: Positive = 30.0
    """Most processor time for reading an asset, seconds."""
    max_memory_mb: Annotated[int, Field(ge=1024)] = 2048
    """Most memory for reading an asset, MiB."""


USUAL_DENSITY = 600.0
"""kg/m^3: of wood, or of things with hollows."""


def value_of(given: float | Mapping[str, float], category: str, usual: float) -> float:
    """What a key that has a number, or a map of numbers by category, says of this one; `usual` where the map lacks it."""
    return given.get(category, usual) if isinstance(given, Mapping) else given


Density = Annotated[
    Annotated[Positive, Tag("[number]")] | Annotated[dict[CategoryName, Positive], Field(min_length=1), Tag("[map]")],
    among_kinds("[number]", "[map]"),
]


class Assets(Frozen):
    """Where objects and tables come from; sources are mixed by weight."""

    objects: tuple[Source, ...] = Field(default=(ProceduralSource(source="procedural"),), min_length=1, max_length=100)
    """Sources of objects."""
    tables: tuple[Source, ...] = Field(default=(ProceduralSource(source="procedural"),), min_length=1, max_length=100)
    """Sources of tables."""
    split: SplitShares = SplitShares()
    """Shares of instances in train, val and test."""
    density_kg_m3: Density = USUAL_DENSITY
    """Density of a watertight solid; or by category, `{mug: 2400}`, where others have the default."""
    shell_kg_m2: Positive = 3.0
    """Surface density of a mesh that is not watertight, a thin shell."""

    def density_of(self, category: str) -> float:
        """kg/m^3 of a watertight solid of this category."""
        return value_of(self.density_kg_m3, category, USUAL_DENSITY)

    @field_validator("objects")
    @classmethod
    def _are_objects(cls, sources: tuple[Source, ...]) -> tuple[Source, ...]:
        if kinds := [one.kind for one in sources if isinstance(one, ProceduralSource) and one.kind != TABLE]:
            raise ValueError(f"kind: {kinds[0]} makes what objects lie in: write it in a source of assets.tables")
        return sources
