"""Merged files with wrong lines, which plain verify cannot tell, and healthy datasets of every kind."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import services.merge.tables
from services.read.audit import describe_independent, verify_independently
from tests.datasets import faults_of, make_dataset

Plant = Callable[[Callable, Callable], None]

SCENES = 2


def transposed_poses_in_camposes(plant: Plant, _: Any) -> None:
    original = services.merge.tables.cam_pose_lines

    def planted(views):
        rows = [line.split(",") for line in original(views).decode().splitlines()]
        turned = [[*words[:2], *np.array(words[2:]).reshape(4, 4).T.ravel()] for words in rows]
        return "".join(",".join(words) + "\n" for words in turned).encode()

    plant(original, planted)


def cx_and_cy_swapped_in_cameras(plant: Plant, _: Any) -> None:
    original = services.merge.tables.camera_lines

    def planted(views):
        rows = [line.split(",") for line in original(views).decode().splitlines()]
        return "".join(",".join([*words[:7], words[8], words[7], *words[9:]]) + "\n" for words in rows).encode()

    plant(original, planted)


def u_and_v_swapped_in_objects(plant: Plant, _: Any) -> None:
    original = services.merge.tables.object_lines

    def planted(objects):
        rows = [line.split(" ") for line in original(objects).decode().splitlines()]
        return "".join(" ".join([*words[:4], words[5], words[4], *words[6:]]) + "\n" for words in rows).encode()

    plant(original, planted)


@pytest.mark.parametrize(
    ("planted", "told"),
    [
        (transposed_poses_in_camposes, "camPoses.csv: T01, T02, T03, "),
        (cx_and_cy_swapped_in_cameras, "cameras.csv: cx, cy in the line of pose_id"),
        (u_and_v_swapped_in_objects, "objects.dat: u, v in the line of pose_id"),
    ],
)
def test_a_wrong_line_passes_plain_verify_and_not_the_second_derivation(tmp_path, monkeypatch, plant, planted, told):
    planted(plant, monkeypatch)
    store, _ = make_dataset(tmp_path, scenes=SCENES)
    assert faults_of(store) == []
    faults = verify_independently(store, SCENES, lambda _: None).faults
    assert any(told in fault for fault in faults), faults


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"objects_per_scene": 3, "pairs_per_scene": 2},
        {"cameras": {"mirror": {"pivot_depth": "median"}}, "output": {"layout": "tar"}},
        {"cameras": {"mirror": {"enabled": False}}, "images": {"projection": {"enabled": False}}},
        {"cameras": {"depth": {"enabled": False}}, "render": {"rgb": False}},
        {"sensor": {"depth_noise": {}, "distortion": {"k1": -0.1}}},
        {"images": {"projection": {"splat": 3}}},
    ],
    ids=lambda changes: "+".join(changes) or "defaults",
)
def test_a_healthy_dataset_has_no_faults(tmp_path: Path, changes: dict[str, Any]):
    store, _ = make_dataset(tmp_path, **changes)
    found = verify_independently(store, 9, lambda _: None)
    assert found.faults == []
    assert (found.scenes, found.pairs) == (2, 2 * changes.get("pairs_per_scene", 1))
    assert "nothing off" in "\n".join(describe_independent(found))
