"""One query and one training loader read a dataset of scenes and a dataset of captures together."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pytest

from tests.captures import captures_job, use_exact_captures
from tests.datasets import make_dataset, run_here


def load_examples(*folders: Path) -> Iterator[dict[str, Any]]:
    """What a network is trained on, for every pair of some datasets; knows pyarrow, OpenCV and the tables alone.

    Colour, depth and mask of the input view, depth of the view from the other side, its pose, and whether it was captured.
    """
    for folder in folders:
        pairs: dict[int, dict] = {}
        for row in ds.dataset(folder / "manifest/views", partitioning="hive").to_table().to_pylist():
            pairs.setdefault(row["parent_id"], {})[row["role"]] = row
        for pair in pairs.values():
            images = {
                (role, Path(file["path"]).name.rstrip("0123456789.png")): np.asarray(
                    cv2.imread(str(folder / file["path"]), cv2.IMREAD_UNCHANGED)
                )
                for role in ("input", "mirror")
                for file in pair[role]["files"]
                if "/patches/" not in file["path"]
            }
            first = pair["input"]
            T_in, T_mirror = (np.reshape(pair[role]["T_world_cam"], (4, 4)) for role in ("input", "mirror"))
            yield {
                "rgb": images["input", "RGB"],
                "depth_m": images["input", "depth"] / first["depth_units_per_m"],
                "mask": images["input", "segment"] >= 3,
                "mirror_depth_m": images["mirror", "depth"] / pair["mirror"]["depth_units_per_m"],
                "T_mirror_input": np.linalg.inv(T_mirror) @ T_in,
                "K": np.array([[first["fx"], 0, first["cx"]], [0, first["fy"], first["cy"]], [0, 0, 1]]),
                "captured": first.get("capture") is not None,
            }


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

    for table in ("views", "objects", "assets", "failures", "timings"):
        parts = [ds.dataset(one / "manifest" / table, partitioning="hive") for one in both]
        assert ds.dataset(parts).count_rows() == sum(part.count_rows() for part in parts), table


def test_one_loader_reads_pairs_of_both(both):
    examples = list(load_examples(*both))
    assert [one["captured"] for one in examples] == [False] * 2 + [True] * 4
    for one in examples:
        depth, other, K = one["depth_m"], one["mirror_depth_m"], one["K"]
        assert one["rgb"].shape[:2] == depth.shape == one["mask"].shape == other.shape and one["mask"].any()
        rows, columns = np.nonzero(one["mask"] & (depth > 0))
        z = depth[rows, columns]
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(z))])
        points = one["T_mirror_input"] @ np.vstack([np.linalg.inv(K) @ pixels * z, np.ones(len(z))])
        seen = K @ points[:3]
        u, v = np.floor(seen[:2] / seen[2]).astype(int)
        inside = (u >= 0) & (v >= 0) & (u < depth.shape[1]) & (v < depth.shape[0])
        assert inside.mean() > 0.9, "the mirror camera looks at the same object"
        # What the input camera sees lies on the object as the other side has it, or behind that.
        behind = np.median(points[2][inside] - other[v[inside], u[inside]])
        assert -0.01 < behind < 0.3
