"""One query and one training loader read a dataset of scenes and a dataset of captures together."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pytest

from tests.captures import captures_job, use_exact_captures
from tests.datasets import make_dataset, run_here


@dataclass
class Example:
    """What a network is trained on: the input view, and depth and pose of the view from the other side."""

    rgb: np.ndarray
    depth_m: np.ndarray
    mask: np.ndarray
    mirror_rgb: np.ndarray
    mirror_depth_m: np.ndarray
    T_mirror_input: np.ndarray
    K: np.ndarray
    captured: bool


def load_examples(*folders: Path) -> Iterator[Example]:
    """Every pair of some datasets; knows pyarrow, OpenCV and the tables, and nothing of the project."""
    for folder in folders:
        views = ds.dataset(folder / "manifest/views", partitioning="hive").to_table().to_pylist()
        pairs: dict[int, dict] = {}
        for row in views:
            pairs.setdefault(row["parent_id"], {})[row["role"]] = row
        for pair in pairs.values():
            first, mirror = pair["input"], pair["mirror"]
            images = {
                (role, Path(file["path"]).name.rstrip("0123456789.png")): np.asarray(
                    cv2.imread(str(folder / file["path"]), cv2.IMREAD_UNCHANGED)
                )
                for role, row in (("input", first), ("mirror", mirror))
                for file in row["files"]
                if "/patches/" not in file["path"]
            }
            T_in, T_mirror = (np.reshape(row["T_world_cam"], (4, 4)) for row in (first, mirror))
            yield Example(
                images["input", "RGB"],
                images["input", "depth"] / first["depth_units_per_m"],
                images["input", "segment"] >= 3,
                images["mirror", "RGB"],
                images["mirror", "depth"] / mirror["depth_units_per_m"],
                np.linalg.inv(T_mirror) @ T_in,
                np.array([[first["fx"], 0, first["cx"]], [0, first["fy"], first["cy"]], [0, 0, 1]]),
                first.get("capture") is not None,
            )


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> tuple[Path, Path]:
    scenes, captures = tmp_path_factory.mktemp("scenes"), tmp_path_factory.mktemp("captures")
    make_dataset(scenes, categories=["mug", "box"])
    with pytest.MonkeyPatch.context() as patch:
        use_exact_captures(patch)
        run_here(captures_job(), captures)
    return scenes, captures


def test_one_query_tells_captures_from_simulations_in_both_datasets(both):
    for order in (both, both[::-1]):
        scenes = ds.dataset([ds.dataset(one / "manifest/scenes", partitioning="hive") for one in order])
        rows = scenes.to_table(columns=["source", "category", "penetration_mm", "capture"]).to_pylist()
        kinds = sorted((row["source"], row["capture"] is not None, row["penetration_mm"] is None) for row in rows)
        assert kinds == [("procedural", False, False)] * 2 + [("simulated_capture", True, True)] * 2
        measured = scenes.to_table(filter=pc.is_valid(ds.field("capture")))
        assert measured.num_rows == 2


@pytest.mark.parametrize("table", ["views", "objects", "assets", "failures", "timings"])
def test_every_table_of_both_reads_as_one(both, table):
    parts = [ds.dataset(one / "manifest" / table, partitioning="hive") for one in both]
    assert ds.dataset(parts).count_rows() == sum(part.count_rows() for part in parts)


def test_one_loader_reads_pairs_of_both(both):
    examples = list(load_examples(*both))
    assert [one.captured for one in examples] == [False] * 2 + [True] * 4
    for one in examples:
        assert one.rgb.shape[:2] == one.depth_m.shape == one.mask.shape == one.mirror_depth_m.shape
        assert one.mask.any()
        rows, columns = np.nonzero(one.mask & (one.depth_m > 0))
        z = one.depth_m[rows, columns]
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(z))])
        points = one.T_mirror_input @ np.vstack([np.linalg.inv(one.K) @ pixels * z, np.ones(len(z))])
        seen = one.K @ points[:3]
        u, v = np.floor(seen[:2] / seen[2]).astype(int)
        inside = (u >= 0) & (v >= 0) & (u < one.rgb.shape[1]) & (v < one.rgb.shape[0])
        assert inside.mean() > 0.9  # the mirror camera looks at the same object
        # What the input camera sees lies on the object as the other side has it, or behind that.
        other = one.mirror_depth_m[v[inside], u[inside]]
        assert np.median(points[2][inside] - other) > -0.01
        assert np.median(points[2][inside] - other) < 0.3
