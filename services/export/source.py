"""What an export reads: the scenes and pairs of a dataset that were chosen, and the sources of their shapes."""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from schemas.dataset.codec import Row
from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import PixelKind, patch_index, view_name
from schemas.job.assets import SplitShares
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import DRAWN_ROLES, ROLES, Role
from services.dataset.dataset import Splits, collect_ids, split_by_category, strictest
from services.read.dataset_reader import (
    ReadFile,
    StoredRange,
    committed_reader,
    decode_samples,
    file_reader,
    patch_paths,
    region_names,
    view_paths,
)
from workers.store.commit import split_code
from workers.store.images import decode_png, encode_png
from workers.store.ledger import range_rows, read_range
from workers.store.store import Store

SIDES: tuple[Role, ...] = ("input", "mirror")
"""Views from two sides; that of the depth camera beside the input camera shows what the input view does."""
MM_PER_M = 1000.0


@dataclass(frozen=True, eq=False)
class ExportPair:
    """A pair of views, and the views of cameras of `cameras.more` that go with it.

    The rows of `views` by name (`view_name`), of `objects`, and its images as the PNG bytes that are stored.
    """

    number: int
    """Its place among the pairs of its scene, from 0."""
    views: dict[Role, Row]
    objects: tuple[Row, ...]
    read: ReadFile

    @property
    def pose_id(self) -> int:
        """Of the input pose."""
        return int(next(iter(self.views.values()))["parent_id"])

    @property
    def drawn(self) -> list[Role]:
        """The roles of its views that are drawn, in order."""
        return [role for role in DRAWN_ROLES if role in self.views]

    @property
    def named(self) -> list[Role]:
        """The names of the views of named cameras, in order."""
        return [name for name in self.views if name not in ROLES]

    @property
    def names(self) -> list[Role]:
        """The names of all views, in the order of `ROLES` and then of `named`."""
        return [*(role for role in ROLES if role in self.views), *self.named]

    @property
    def all_drawn(self) -> list[Role]:
        """The names of all views that are drawn, in order."""
        return [*self.drawn, *self.named]

    @property
    def sides(self) -> list[Role]:
        """The names of the views from other sides: `SIDES`, and those of named cameras."""
        return [*(role for role in SIDES if role in self.views), *self.named]

    def lacks_colour(self, *names: Role) -> str:
        """Why it is left out of what needs the colour of these views, of every drawn one where none is named; or nothing."""
        missing = [name for name in names or self.all_drawn if self.image(name, "rgb") is None]
        return f"no rgb of the {missing[0]} view" if missing else ""

    @cached_property
    def _labels(self) -> dict[Role, list[Row]]:
        by_name: dict[Role, list[Row]] = {}
        for row in sorted(self.objects, key=itemgetter("region_id")):
            by_name.setdefault(view_name(row["role"], row["number"]), []).append(row)
        return by_name

    def labels(self, role: Role) -> list[Row]:
        """Rows of `objects` of one view, by region: the table first."""
        return self._labels.get(role, [])

    def label(self, role: Role, region_id: int) -> Row | None:
        """The row of `objects` of one region in one view, None where the view is not stored."""
        return next((row for row in self.labels(role) if row["region_id"] == region_id), None)

    def image(self, role: Role, kind: PixelKind) -> bytes | None:
        """The PNG of an image, None where the job stores none. Raises CorruptError where it is committed and missing."""
        return self._read(view_paths(self.views[role]).get(kind)) if role in self.views else None

    def patch(self, role: Role, kind: PixelKind, region_id: int, objects: int) -> bytes | None:
        """The PNG of an object's patch, None where there is none: it would leave the image, or was not asked for."""
        if role not in self.views:
            return None
        return self._read(patch_paths(self.views[role], patch_index(region_id, objects)).get(kind))

    def _read(self, path: str | None) -> bytes | None:
        return None if path is None else self.read(path)

    def images(self, role: Role, kind: PixelKind) -> list[bytes]:
        """The PNGs of a kind of image that every object has one of, by region; none where the job stores none."""
        paths = view_paths(self.views[role]) if role in self.views else {}
        names = [kind] if kind in paths else map(f"{kind}{{}}".format, itertools.count())
        return [self.read(paths[name]) for name in itertools.takewhile(paths.__contains__, names)]

    def stack(self, role: Role, kind: PixelKind) -> NDArray | None:
        """[objects, H, W] of the same images, None where there is none."""
        images = self.images(role, kind)
        return np.stack([decode_png(data) for data in images]) if images else None

    def pixels(self, role: Role, kind: PixelKind) -> NDArray | None:
        """An image decoded: [H, W, 3] uint8 RGB, [H, W] uint16 depth, [H, W] uint8 regions; None where there is none."""
        data = self.image(role, kind)
        return None if data is None else decode_png(data, f"{kind} of the {role} view of pose {self.pose_id}")

    def alone(self, role: Role, region_id: int) -> bytes:
        """The PNG of a view's colour as RGBA: as stored, or with the pixels of an object as alpha. The view has colour."""
        data, rgb, region = self.image(role, "rgb"), self.pixels(role, "rgb"), self.pixels(role, "region")
        assert data is not None and rgb is not None and region is not None
        if rgb.shape[2] == 4:
            return data
        return encode_png(np.dstack([rgb, np.where(region == region_id, np.uint8(255), np.uint8(0))]))

    def depth(self, role: Role, units_per_m: float) -> bytes | None:
        """The PNG of a view's depth in other units; what does not fit 16 bits becomes 0, as all depth out of range."""
        data = self.image(role, "depth")
        return None if data is None else in_units(data, self.views[role]["depth_units_per_m"], units_per_m)


@dataclass(frozen=True, eq=False)
class ExportScene:
    """A scene that was made: its row, its pairs, and the rows of `assets` of what stands in it, by instance."""

    row: Row
    pairs: tuple[ExportPair, ...]
    assets: dict[str, Row]
    read: ReadFile
    """Reads a file by its path that is not in a tar; CorruptError where there is none."""
    stored: StoredRange

    @property
    def scene_id(self) -> int:
        """Its id in the dataset."""
        return int(self.row["scene_id"])

    @property
    def category(self) -> str:
        """That of its first object."""
        return str(self.row["category"])

    @cached_property
    def instances(self) -> dict[int, tuple[str, str]]:
        """(category, instance id) of every object, by region id."""
        return {region: name for region, name in region_names(self.row).items() if region >= REGION_FIRST_OBJECT}

    @cached_property
    def shown(self) -> tuple[str, ...]:
        """The instances of the table, where there is one, and of every object."""
        table = self.row["table_id"]
        return (*(() if table is None else (table,)), *(name for _, name in self.instances.values()))

    def samples(self, instance_id: str) -> Mapping[str, NDArray]:
        """The shape targets of an instance by key; none where it has none. Raises CorruptError for a damaged or missing file."""
        stored = self.assets[instance_id]["samples"]
        return {} if stored is None else decode_samples(self.read(stored["path"]), stored["path"])

    @property
    def split(self) -> str:
        """The strictest of its objects' splits."""
        return strictest(self.assets[name]["split"] for _, name in self.instances.values())


def in_units(data: bytes, units_per_m: float, wanted_per_m: float) -> bytes:
    """The PNG of a depth image in other units, as `ExportPair.depth` has it."""
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


def scenes_of(store: Store, stored: StoredRange, chosen: Sequence[int], splits: Splits) -> Iterator[ExportScene]:
    """The chosen scenes of a range, in order. Files are read when they are asked for; tars are read once."""
    if not chosen:
        return
    read_plain = committed_reader(store, stored.records)
    read = file_reader(read_plain, stored.records)
    assets = {row["instance_id"]: {**row, "split": splits.of(row)} for row in stored.rows["assets"]}
    rows = {row["scene_id"]: row for row in stored.rows["scenes"]}
    for scene_id in chosen:
        pairs = enumerate(stored.pairs(scene_id))
        pairs_read = tuple(ExportPair(number, views, tuple(objects), read) for number, (views, objects) in pairs)
        yield ExportScene(rows[scene_id], pairs_read, assets, read_plain, stored)
