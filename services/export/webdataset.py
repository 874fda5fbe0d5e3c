"""Format `webdataset`: tar shards of bounded size, a sample for each pair, by split.

The members of a sample are `<pose id>.<role>.rgb.png`, `<pose id>.depth.npz` and `<pose id>.region.npz` with an array for each
role, likewise image targets of the job, and `<pose id>.json` with the rows of scene, views and objects. Numbers are no PNG,
because the usual decoders of WebDataset turn every picture into colours: 16 bits into 8, and region ids into shares of 255.
"""

import io
import json
import tarfile
from pathlib import Path
from typing import Any, ClassVar, Final

from schemas.dataset.codec import Row
from schemas.dataset.tables import OF_TARGETS
from schemas.scene.view import MODALITIES, ROLES
from services.export.formats import OF_SCENE, Added, ShardedWriter, encode_npz
from services.export.source import ExportPair, ExportScene

_PICTURES: Final = tuple(name for name, kind in MODALITIES.items() if (kind.channels, kind.dtype) == (3, "uint8"))
"""Modalities that are stored as PNG files; those of numbers are arrays."""
_OF_SCENE: Final = (*OF_SCENE, "effects")
_NOT_OF_VIEWS: Final = ("files", "scene_id", "category", "parent_id", "capture")
_NOT_OF_OBJECTS: Final = ("scene_id", "pose_id", "role")


class WebDataset(ShardedWriter):
    """Writes train-000000.tar and so on; every pair that the dataset has is a sample."""

    FRESH: ClassVar = {"rounds": None, "samples": {}, "without_shape": []}
    PATTERN = "{split}-{number:06d}.tar"

    def open_shard(self, path: Path) -> "_Tar":
        """A tar."""
        return _Tar(path)

    def add(self, scene: ExportScene) -> Added:
        """Writes a sample for each pair of the scene, and its shapes."""
        self.put_shapes(scene)
        shard = self.rounds.shard(scene.split)
        for pair in scene.pairs:
            for name, data in members_of(scene, pair):
                shard.add(f"{pair.pose_id:09d}.{name}", data)
        self.count("samples", scene.split, len(scene.pairs))
        self.rounds.end_if_full()
        return Added(len(scene.pairs))

    def describe(self) -> dict[str, Any]:
        """Shards and samples by split, and the conventions."""
        samples = dict(sorted(self.kept["samples"].items()))
        return {"shards": self.rounds.counts, "samples": samples, **self.conventions("uint16")}


def members_of(scene: ExportScene, pair: ExportPair) -> list[tuple[str, bytes]]:
    """(name behind the key, bytes) of every member of a sample, in order."""
    members: list[tuple[str, bytes]] = []
    for kind, modality in MODALITIES.items():
        if kind in _PICTURES:
            images = {role: pair.image(role, kind) for role in ROLES}
            members += [(f"{role}.{kind}.png", data) for role, data in images.items() if data is not None]
        else:
            read = pair.stack if modality.each else pair.pixels
            arrays = {role: one for role in ROLES if (one := read(role, kind)) is not None}
            if arrays or modality.target is None:
                members.append((f"{kind}.npz", encode_npz(arrays)))
    return [*members, ("json", _json(scene, pair))]


def _json(scene: ExportScene, pair: ExportPair) -> bytes:
    """The rows of a pair, without what is stored elsewhere in the sample."""
    tree: Row = {name: scene.row[name] for name in _OF_SCENE}
    tree |= {"split": scene.split, "pose_id": pair.pose_id, "views": {}}
    for role in ROLES:
        if (row := pair.views.get(role)) is not None:
            labels = [label_of(one) for one in pair.labels(role)]
            columns = {name: value for name, value in row.items() if name not in _NOT_OF_VIEWS}
            tree["views"][role] = {**columns, "objects": labels}
    return json.dumps(tree).encode()


def label_of(row: Row) -> Row:
    """A row of `objects` without what is stored elsewhere in the sample, and without columns of targets that are not there."""
    targets = OF_TARGETS["objects"]
    return {
        key: value
        for key, value in row.items()
        if key not in _NOT_OF_OBJECTS and not (value is None and key in targets)
    }


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
