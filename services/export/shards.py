"""Formats whose pairs share files of bounded size, by split: `webdataset` and `huggingface` (docs/export.md).

In `webdataset` numbers are no PNG, because the usual decoders of WebDataset turn every picture into colours: 16 bits into 8, and
region ids into shares of 255. In `huggingface` targets of 3 x 16 bits are plain bytes, because Pillow, which decodes images for
`datasets`, makes 8 bits of them without a word. Its columns come from the manifest's schemas: what a view has is a struct
`<role>_view`, its images are the columns `<role>_rgb`, `<role>_depth`, `<role>_region` and image targets; of a camera of
`cameras.more`, which may have several views in a pair, these are lists, in order of their numbers.
"""

import hashlib
import io
import json
import tarfile
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from schemas.dataset.codec import Row
from schemas.dataset.layout import ARTICLE, PixelKind, stored_images, stored_roles
from schemas.dataset.tables import OF_TARGETS, SCHEMAS
from schemas.errors import plural
from schemas.job.assets import SPLITS
from schemas.job.job import Job
from schemas.scene.view import MODALITIES, ROLES
from services.dataset.pair import Pair
from services.dataset.view import View
from services.export.formats import OF_SCENE, ShardedWriter, encode_npz
from services.export.source import ExportScene, labels_of, png_of
from services.read.dataset_reader import kinds_of

_COLOURS: Final = tuple(name for name, kind in MODALITIES.items() if (kind.channels, kind.dtype) == (3, "uint8"))
"""Modalities that are stored as PNG files; those of numbers are arrays."""
_OF_SCENE: Final = (*OF_SCENE, "effects")
_NOT_OF_VIEWS: Final = ("files", "scene_id", "category", "parent_id", "capture", "number")
"""Columns that stand elsewhere in a sample."""
_NOT_OF_OBJECTS: Final = ("scene_id", "pose_id")


class WebDataset(ShardedWriter):
    """Writes train-000000.tar and so on; every pair that the dataset has is a sample."""

    FRESH: ClassVar = {"files": {}, "samples": {}, "without_shape": []}
    PATTERN = "{split}-{number:06d}.tar"

    def open_shard(self, path: Path) -> "_Tar":
        """A tar."""
        return _Tar(path)

    def take(self, scene: ExportScene, pair: Pair) -> str:
        """Writes a sample."""
        for name, data in members_of(scene, pair):
            self.shard(scene.split).add(f"{pair.pose_id:09d}.{name}", data)
        self.count("samples", scene.split)
        return ""

    def describe(self) -> dict[str, Any]:
        """Shards and samples by split, and the conventions."""
        counts = {"shards": self.counts("files"), "samples": self.counts("samples")}
        return {**counts, **self.conventions("uint16")}


def members_of(scene: ExportScene, pair: Pair) -> list[tuple[str, bytes]]:
    """(name behind the key, bytes) of every member of a sample, in order."""
    members: list[tuple[str, bytes]] = []
    for kind, modality in MODALITIES.items():
        if kind in _COLOURS:
            members += [
                (f"{name}.{kind}.png", view.png(kind)) for name, view in pair.views.items() if kind in view.images
            ]
        else:
            arrays = {name: array for name, view in pair.views.items() if (array := _array(view, kind)) is not None}
            if arrays or modality.target is None:
                members.append((f"{kind}.npz", encode_npz(arrays)))
    return [*members, ("json", _json(scene, pair))]


def _array(view: View, kind: PixelKind) -> NDArray | None:
    """The pixels of a kind of image, [objects, H, W] of one that each object has; None where there is none."""
    images = [view.image(each) for each in kinds_of(kind, view.images)]
    return None if not images else np.stack(images) if MODALITIES[kind].each else images[0]


def _json(scene: ExportScene, pair: Pair) -> bytes:
    """The rows of a pair, without what is stored elsewhere in the sample."""
    tree: Row = {name: scene.row[name] for name in _OF_SCENE}
    tree |= {"split": scene.split, "pose_id": pair.pose_id, "views": {}}
    for name, view in pair.views.items():
        columns = {key: value for key, value in view.row.items() if key not in _NOT_OF_VIEWS}
        tree["views"][name] = {**columns, "objects": list(map(_label, labels_of(view)))}
    return json.dumps(tree).encode()


def _label(row: Mapping[str, Any]) -> Row:
    """A row of `objects` without what is stored elsewhere in the sample, and without columns of targets that are not there."""
    absent = [name for name in OF_TARGETS["objects"] if row[name] is None]
    left_out = (*_NOT_OF_OBJECTS, "role", "number", "asset", *absent)
    return {name: value for name, value in row.items() if name not in left_out}


class _Tar:
    """A tar being written; its members have no owner and no time."""

    def __init__(self, path: Path) -> None:
        self._tar = tarfile.open(path, "w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115 - `close` closes it
        self.bytes = 0

    def add(self, name: str, data: bytes) -> None:
        header = tarfile.TarInfo(name)
        header.size = len(data)
        self._tar.addfile(header, io.BytesIO(data))
        self.bytes += len(data) + tarfile.BLOCKSIZE

    def close(self) -> None:
        self._tar.close()


SPLIT_NAMES: Final = {split: split for split in SPLITS} | {"val": "validation"}
"""Ours, and Hugging Face's name for it."""
ROW_GROUP, ROW_GROUP_BYTES = 16, 50_000_000
"""Pairs in a row group, and bytes of images that end it earlier: some ten megabytes, which is what a reader holds."""

IMAGE: Final = pa.struct([pa.field("bytes", pa.binary()), pa.field("path", pa.string())])
"""An image as Hugging Face stores it."""
IMAGES: Final = pa.list_(IMAGE)
"""One for each object, by region."""


def _has_pictures(kind: pa.DataType) -> bool:
    """Whether a column's type is that of images, or of lists of them."""
    return kind in (IMAGE, pa.binary()) or (pa.types.is_list(kind) and _has_pictures(kind.value_type))


class HuggingFace(ShardedWriter):
    """Writes data/train-00000.parquet and so on, and README.md."""

    FRESH: ClassVar = {"files": {}, "rows": {}, "licences": [], "without_shape": []}
    PATTERN = "data/{split}-{number:05d}.parquet"

    @cached_property
    def _schema(self) -> pa.Schema:
        return schema_of_pairs(self.record.job)

    def open_shard(self, path: Path) -> "_Parquet":
        """A Parquet file."""
        return _Parquet(path, self._schema)

    def take(self, scene: ExportScene, pair: Pair) -> str:
        """Writes the row of a pair."""
        self.shard(SPLIT_NAMES[scene.split]).add(row_of(self._schema, scene, pair))
        self.count("rows", SPLIT_NAMES[scene.split])
        return ""

    def end_scene(self, scene: ExportScene) -> None:
        """Remembers the licences of what the scene shows."""
        licences = (scene.assets[name]["licence"] for name in scene.shown)
        self.kept["licences"] = sorted({*self.kept["licences"], *licences})
        super().end_scene(scene)

    def finish(self) -> None:
        """Ends the last files, and writes the card."""
        super().finish()
        rows, plan = self.kept["rows"], dict(self.folder.plan)
        if plan["dataset_digest"] is not None:
            del plan["job_digest"]  # which differs where the same dataset is stored otherwise
        export = hashlib.sha256(json.dumps([plan, rows], sort_keys=True).encode()).hexdigest()[:16]
        text = card_text(self.record.job.name, export, self._schema, rows, self.kept["licences"])
        self.folder.put("README.md", text.encode())

    def describe(self) -> dict[str, Any]:
        """Files and rows by split, and the conventions."""
        counts = {"files": self.counts("files"), "rows": self.counts("rows")}
        return {**counts, "licences": self.kept["licences"], **self.conventions("16-bit PNG")}


def schema_of_pairs(job: Job) -> pa.Schema:
    """The columns of a pair, of the types that the manifest gives them; only views and images that the job stores."""
    fields = [SCHEMAS["scenes"].field(name) for name in OF_SCENE]
    fields += [pa.field("split", pa.string()), pa.field("pose_id", pa.int64())]
    views = pa.struct([field for field in SCHEMAS["views"] if field.name not in (*_NOT_OF_VIEWS, "role")])
    for role in stored_roles(job):
        fields += [pa.field(f"{role}_{image.pixels}", _type_of(image.pixels)) for image in stored_images(role, job)]
        fields.append(pa.field(f"{role}_view", views))
    for entry in job.cameras.more:
        images = [(image.pixels, pa.list_(_type_of(image.pixels))) for image in stored_images(entry.name, job)]
        fields += [pa.field(f"{entry.name}_{kind}", of) for kind, of in (*images, ("view", pa.list_(views)))]
    absent = {*(() if job.targets.views else OF_TARGETS["objects"]), *(() if job.cameras.more else ("number",))}
    objects = pa.struct([field for field in SCHEMAS["objects"] if field.name not in (*_NOT_OF_OBJECTS, *absent)])
    schema = pa.schema([*fields, pa.field("objects", pa.list_(objects))])
    # So that `datasets` knows which columns are images.
    features = {field.name: _feature(field.type) for field in schema}
    return schema.with_metadata({b"huggingface": json.dumps({"info": {"features": features}}).encode()})


def _type_of(kind: PixelKind) -> pa.DataType:
    """The type of the column of a kind of image."""
    modality = MODALITIES[kind]
    if (modality.channels, modality.dtype) == (3, "uint16"):
        return pa.binary()
    return IMAGES if modality.each else IMAGE


def row_of(schema: pa.Schema, scene: ExportScene, pair: Pair) -> Row:
    """The row of a pair."""
    row: Row = {name: scene.row[name] for name in OF_SCENE}
    labels = (dict(row) for view in pair.views.values() for row in labels_of(view))
    objects = sorted(labels, key=lambda row: (row["pose_id"], row["role"], row["number"] or 0, row["region_id"]))
    row |= {"split": SPLIT_NAMES[scene.split], "pose_id": pair.pose_id, "objects": objects}
    for name in schema.names:
        role, _, kind = name.partition("_")
        if kind != "view" and kind not in MODALITIES:
            continue
        cells = [_cell(pair, view, kind) for view in pair.views.values() if view.role == role]
        row[name] = next(iter(cells), None) if role in ROLES else cells
    return row


def _cell(pair: Pair, view: View, kind: PixelKind) -> Any:
    """What a view has in the column of its row (`view`) or of an image, or in its place of the column's list."""
    if kind == "view":
        return dict(view.row)
    name, of = f"{pair.pose_id:09d}.{view.name}.{kind}", _type_of(kind)
    if of == IMAGES:
        files = map(view.png, kinds_of(kind, view.images))
        return [{"bytes": data, "path": f"{name}{n}.png"} for n, data in enumerate(files)]
    data = png_of(view, kind)
    return data if data is None or of == pa.binary() else {"bytes": data, "path": f"{name}.png"}


class _Parquet:
    """A Parquet file being written, a row group at a time."""

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        plain = [name for name in schema.names if not _has_pictures(schema.field(name).type)]
        self._writer = pq.ParquetWriter(
            path, schema, compression="snappy", use_dictionary=plain, write_statistics=plain
        )
        self._schema = schema
        self._rows: list[Row] = []
        self.bytes = self._written = 0

    def add(self, row: Row) -> None:
        self._rows.append(row)
        self.bytes += sum(map(_bytes_in, row.values()))
        if len(self._rows) == ROW_GROUP or self.bytes - self._written > ROW_GROUP_BYTES:
            self._flush()

    def _flush(self) -> None:
        if self._rows:
            self._writer.write_table(pa.Table.from_pylist(self._rows, self._schema), row_group_size=ROW_GROUP)
            self._rows, self._written = [], self.bytes

    def close(self) -> None:
        self._flush()
        self._writer.close()


def _bytes_in(cell: object) -> int:
    """Bytes of the images in a cell."""
    if isinstance(cell, bytes):
        return len(cell)
    if isinstance(cell, list):
        return sum(map(_bytes_in, cell))
    return len(cell["bytes"]) if isinstance(cell, dict) and "bytes" in cell else 0


def _feature(kind: pa.DataType) -> dict[str, Any]:
    if kind == IMAGE:
        return {"_type": "Image"}
    if pa.types.is_struct(kind):
        return {field.name: _feature(field.type) for field in kind}
    if pa.types.is_fixed_size_list(kind):
        return {"feature": _feature(kind.value_type), "length": kind.list_size, "_type": "List"}
    if pa.types.is_list(kind):
        return {"feature": _feature(kind.value_type), "_type": "List"}
    return {"dtype": "float64" if kind == pa.float64() else str(kind), "_type": "Value"}


def card_text(name: str, export: str, schema: pa.Schema, rows: Mapping[str, int], licences: Sequence[str]) -> str:
    """README.md: the head that Hugging Face reads, and what a person wants to know.

    `datasets` keeps what it loaded by the folder's last name and this head alone, so that each export needs a head of its own.
    """
    files = "".join(f"\n  - split: {split}\n    path: data/{split}-*.parquet" for split in sorted(rows)) or " []"
    counts = "".join(f"- {split}: {plural(count, 'pair')}\n" for split, count in sorted(rows.items()))
    columns = "".join(f"- `{field.name}`: {_describe_column(field)}\n" for field in schema)
    wide = _WIDE if any(field.type in (pa.binary(), pa.list_(pa.binary())) for field in schema) else ""
    return f"""---
license: {"cc0-1.0" if set(licences) <= {"CC0-1.0"} else "other"}
pretty_name: {json.dumps(name)}
task_categories:
- depth-estimation
- image-to-3d
configs:
- config_name: default
  description: export {export}
  data_files:{files}
---

# {name}

Views with depth for reconstructing objects from a single view. A row is a pair: an input view of an object, and what the job has
of the mirror view from the other side and of views of further cameras. Made by Verso after {ARTICLE}.
Splits are by object: no object of `test` or `validation` is seen in `train`.

{counts}
Licences of the shapes: {", ".join(licences) or "none"}.

```python
import datasets

pairs = datasets.load_dataset("path/to/this/folder", split="train")
```

## Columns

{columns}
## Conventions

- Depth is a 16-bit PNG: z along the optical axis. Divide by `depth_units_per_m` of the view for metres; 0 is no depth.
- Regions: 0 nothing, 1 floor, 2 table, 3 and up objects.
- Poses are row-major 4 x 4 matrices in metres: `T_world_cam` takes camera to world coordinates, `T_cam_obj` object to camera
  coordinates. Camera frames are optical: x right, y down, z forward. The world's z is up.
- `cx`, `cy` have pixel centres at +0.5; `cx_opencv`, `cy_opencv` have them on integers, as OpenCV does.
{wide}- `shapes/<category>/<instance_id>.glb` is the shape of an object of `objects`, in the object frame: metres, z up.
"""


_WIDE: Final = """\
- PNG files of 3 x 16 bits are bytes, because Pillow makes 8 bits of them without a word. As numbers x from 0 to 1:
  `cv2.imdecode(numpy.frombuffer(cell, numpy.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1] / 65535`. A normal is 2 x - 1, in the
  camera's frame; a point of an object `coordinates_scale_m` x + `coordinates_offset_m`, in its own frame; (0, 0, 0) is none.
"""


def _describe_column(field: pa.Field) -> str:
    of_pair = field.name == "objects" or field.name.partition("_")[0] in ROLES
    named = pa.types.is_list(field.type) and not of_pair
    return f"for each view: {_describe(field.type.value_type)}" if named else _describe(field.type)


def _describe(kind: pa.DataType) -> str:
    if kind == IMAGE:
        return "image"
    if kind in (IMAGES, pa.binary()):
        return "list of images, one for each object" if kind == IMAGES else "PNG of 3 x 16 bits, as bytes"
    if pa.types.is_list(kind):
        return "list of " + ", ".join(f"`{item.name}`" for item in kind.value_type)
    if pa.types.is_struct(kind):
        return "struct of " + ", ".join(f"`{item.name}`" for item in kind)
    return "matrix" if pa.types.is_fixed_size_list(kind) else str(kind)
