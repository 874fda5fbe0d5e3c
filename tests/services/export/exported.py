"""What tests of exports share: one call that exports, a picture of a folder, and the dataset as its own documents tell it."""

import csv
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.dataset as ds
from numpy.typing import NDArray

from services.export.export import ExportResult, export
from services.export.formats import Choice, ExportRequest
from services.job.record import require_job
from workers.store.local import LocalStore
from workers.store.store import Store


def export_to(store: Store, target: Path, name: Any, **asked: Any) -> ExportResult:
    """The result of an export; `asked`: fields of Choice, points, and shard_mb: 0 ends a shard after each scene."""
    shard_mb, points = asked.pop("shard_mb", 256), asked.pop("points", 0)
    return export(ExportRequest(store, target, name, Choice(**asked), shard_mb, points))


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder by path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def source_image(root: Path | None, category: str, content: str, pose_id: int) -> NDArray:
    """An image of a dataset of the `files` layout, read as its documents tell: RGB, depth or region ids."""
    assert root is not None
    pixels = cv2.imread(str(root / category / f"{content}{pose_id:05d}.png"), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels[..., ::-1] if pixels.ndim == 3 else pixels


def source_poses(root: Path | None) -> dict[int, NDArray]:
    """[4, 4] camera to world by pose id, from camPoses.csv."""
    assert root is not None
    with (root / "camPoses.csv").open() as file:
        rows = list(csv.reader(file))[1:]
    return {int(row[0]): np.reshape([float(x) for x in row[2:]], (4, 4)) for row in rows}


def source_rows(root: Path | None, table: str) -> list[dict[str, Any]]:
    """The rows of a merged table."""
    return ds.dataset(f"{root}/manifest/{table}", partitioning="hive").to_table().to_pylist()


def without_sources(store: LocalStore, place: Path) -> LocalStore:
    """A copy whose job's sources hold something else now."""
    shutil.copytree(store.root, place)
    job, catalogue = place / "job.yaml", require_job(store).catalogue
    job.write_text(job.read_text().replace(catalogue, "f" * len(catalogue)))
    return LocalStore(place)
