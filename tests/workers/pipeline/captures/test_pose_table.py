"""poses.parquet: residuals before and after, and the camera columns of a dataset."""

import io

import numpy as np
import pyarrow.parquet as pq
import pytest

from schemas.capture import CaptureCamera, CaptureEstimate, Estimates, ViewEstimate
from schemas.dataset.tables import SCHEMAS
from schemas.scene.view import Intrinsics
from workers.capture.process import SCHEMA, pose_table
from workers.geometry.frames import translation

CAMERA = CaptureCamera(Intrinsics(width=1920, height=1080, fx=912.0, fy=911.0, cx=961.9, cy=548.8), np.zeros(8))


def estimates():
    covariance = np.diag([1e-6, 4e-6, 1e-8, 1e-8, 1e-8, 9e-8])
    before = [ViewEstimate(n, "used", translation(n, 0, 0), None, 30, 0.5, 4.0) for n in (0, 2)]
    after = [
        ViewEstimate(0, "used", translation(0, 1, 0), covariance, 30, 0.2, 1.0),
        ViewEstimate(2, "refused", None, None, 0, None, None, ("no marker",)),
    ]
    views = {"markers": CaptureEstimate("markers", tuple(before)), "joint": CaptureEstimate("joint", tuple(after))}
    return Estimates("joint", views, ())


def test_rows_have_residuals_before_and_after():
    rows = pq.read_table(io.BytesIO(pose_table(estimates(), CAMERA))).to_pylist()
    assert [(row["estimate"], row["number"], row["chosen"]) for row in rows] == [
        ("markers", 0, False),
        ("markers", 2, False),
        ("joint", 0, True),
        ("joint", 2, True),
    ]
    joint = rows[2]
    assert (joint["reprojection_before_px"], joint["reprojection_px"]) == (0.5, 0.2)
    assert (joint["depth_before_mm"], joint["depth_mm"]) == (4.0, 1.0)
    assert joint["sigma_mm"] == pytest.approx(2.0) and joint["sigma_deg"] == pytest.approx(np.degrees(3e-4))
    assert rows[3]["T_world_cam"] is None and rows[3]["reasons"] == ["no marker"] and rows[3]["sigma_mm"] is None


def test_camera_columns_are_those_of_a_datasets_views():
    views = SCHEMAS["views"]
    for name in ("T_world_cam", "width", "height", "fx", "fy", "cx", "cy", "cx_opencv", "cy_opencv"):
        assert SCHEMA.field(name).type == views.field(name).type
    row = pq.read_table(io.BytesIO(pose_table(estimates(), CAMERA))).to_pylist()[1]
    assert row["cx"] - row["cx_opencv"] == 0.5 and np.reshape(row["T_world_cam"], (4, 4))[0, 3] == 2.0
