"""What an export reads: the scenes of a dataset that were chosen, with their pairs, and what it asks of views."""

from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.dataset.codec import Row
from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import PixelKind
from schemas.job.assets import SplitShares
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import DRAWN_ROLES, Role
from services.dataset.dataset import Dataset, Splits, collect_ids, pairs_of, split_by_category, strictest
from services.dataset.pair import Pair
from services.dataset.view import Pixels, View
from services.read.dataset_reader import ReadFile, decode_samples, region_names
from workers.store.commit import split_code
from workers.store.images import decode_png, encode_png
from workers.store.ledger import range_rows, read_range
from workers.store.store import Store

SIDES: tuple[Role, ...] = ("input", "mirror")
"""Views from two sides; that of the depth camera beside the input camera shows what the input view does."""
MM_PER_M = 1000.0


def drawn(pair: Pair) -> list[View]:
    """The views of a pair that are drawn, in order, but for those of named cameras."""
    return [pair.views[role] for role in DRAWN_ROLES if role in pair.views]


def named(pair: Pair) -> list[View]:
    """The views of named cameras that go with a pair, in order."""
    return [view for view in pair.views.values() if view.number is not None]


def all_drawn(pair: Pair) -> list[View]:
    """All views that are drawn, in order."""
    return [*drawn(pair), *named(pair)]


def sides(pair: Pair) -> list[View]:
    """The views from other sides: `SIDES`, and those of named cameras."""
    return [*(pair.views[role] for role in SIDES if role in pair.views), *named(pair)]


def labels_of(view: View) -> list[Mapping[str, Any]]:
    """Rows of `objects` of a view, by region, the table first; a projected view has none of its own."""
    return [] if view.role == "projected" else [view.regions[region] for region in sorted(view.regions)]


def png_of(pixels: Pixels | None, kind: PixelKind) -> bytes | None:
    """The file of an image, None where there is none. Raises CorruptError where it is committed and missing."""
    return pixels.png(kind) if pixels is not None and kind in pixels.images else None


def alone(view: View, region_id: int) -> bytes:
    """The PNG of a view's colour as RGBA: as stored, or with the pixels of an object as alpha."""
    rgb = view.image("rgb")
    if rgb.shape[2] == 4:
        return view.png("rgb")
    return encode_png(np.dstack([rgb, np.where(view.segment() == region_id, np.uint8(255), np.uint8(0))]))


def depth_of(view: View, units_per_m: float) -> bytes:
    """The PNG of a view's depth in other units; what does not fit 16 bits becomes 0, as all depth out of range."""
    return in_units(view.png("depth"), view.depth_units_per_m, units_per_m)


@dataclass(frozen=True, eq=False)
class ExportScene:
    """A scene that was made: its pairs, and the rows of `assets` of what stands in its range, by instance."""

    pairs: tuple[Pair, ...]
    assets: dict[str, Row]
    read: ReadFile
    """Reads a file by its path that is not in a tar; CorruptError where there is none."""

    @property
    def row(self) -> Mapping[str, Any]:
        """Its row of `scenes`."""
        return self.pairs[0].scene

    @property
    def scene_id(self) -> int:
        """Its id in the dataset."""
        return self.pairs[0].scene_id

    @property
    def category(self) -> str:
        """That of its first object."""
        return self.pairs[0].category

    @cached_property
    def instances(self) -> dict[int, tuple[str, str]]:
        """(category, instance id) of every object, by region id."""
        return {region: name for region, name in region_names(self.row).items() if region >= REGION_FIRST_OBJECT}

    @cached_property
    def shown(self) -> tuple[str, ...]:
        """The instances of the table, where there is one, and of every object."""
        return tuple(name for _, name in region_names(self.row).values())

    def samples(self, instance_id: str) -> Mapping[str, NDArray]:
        """The shape targets of an instance by key; none where it has none. Raises CorruptError for a damaged or missing file."""
        stored = self.assets[instance_id]["samples"]
        return {} if stored is None else decode_samples(self.read(stored["path"]), stored["path"])

    @property
    def split(self) -> str:
        """The strictest of its objects' splits."""
        return strictest(self.assets[name]["split"] for _, name in self.instances.values())


def in_units(data: bytes, units_per_m: float, wanted_per_m: float) -> bytes:
    """The PNG of a depth image in other units, as `depth_of` has it."""
    if units_per_m == wanted_per_m:
        return data
    depth = np.rint(decode_png(data) * (wanted_per_m / units_per_m))
    return encode_png(np.where(depth <= np.iinfo(np.uint16).max, depth, 0).astype(np.uint16))


def iter_records(store: Store, codes: NDArray[np.int64]) -> Iterator[list[CommitRecord]]:
    """The records of the committed ranges that `codes` name, in order."""
    for start, group in groupby(map(split_code, codes), key=itemgetter(0)):
        yield read_range(store, start, [retry for _, retry in group])


def splits_of(
    store: Store, codes: NDArray[np.int64], shares: SplitShares, held_out: Collection[str], by_category: bool
) -> Splits:
    """The splits of the instances in the ranges that `codes` name."""
    if not by_category and not held_out:
        return Splits({})
    tables = (range_rows(store, records, "assets") for records in iter_records(store, codes))
    ids = collect_ids(table.select(["instance_id", "category"]).to_pylist() for table in tables)
    return Splits(split_by_category(ids, shares) if by_category else {}, frozenset(held_out))


def scenes_of(
    dataset: Dataset, records: Sequence[CommitRecord], chosen: Set[int], splits: Splits
) -> Iterator[ExportScene]:
    """The chosen scenes of a range that were made, in order. Files are read when they are asked for."""
    if not chosen:
        return
    rows, files = dataset.open_range(records)
    assets = {row["instance_id"]: {**row, "split": splits.of(row)} for row in rows.assets.to_pylist()}
    for scene_id in sorted(chosen & set(rows.pairs["scene_id"].to_pylist())):
        yield ExportScene(tuple(pairs_of(rows.of_scene(scene_id), files)), assets, files.read)
