"""poses.parquet: every view in every estimate, with its residuals before and after. Pure."""

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from schemas.capture.estimate import Estimates, ViewEstimate
from schemas.capture.view import CaptureCamera
from schemas.dataset.codec import Row, camera_columns
from schemas.scene.view import Camera

_f64, _i64, _str = pa.float64(), pa.int64(), pa.string()
_matrix = pa.list_(pa.field("item", _f64, nullable=False), 16)

SCHEMA = pa.schema(
    [
        pa.field("number", _i64, False),
        pa.field("estimate", _str, False),
        pa.field("chosen", pa.bool_(), False),
        pa.field("status", _str, False),
        pa.field("reasons", pa.list_(_str), False),
        pa.field("T_world_cam", _matrix, True),
        *(pa.field(name, _i64, False) for name in ("width", "height")),
        *(pa.field(name, _f64, False) for name in ("fx", "fy", "cx", "cy", "cx_opencv", "cy_opencv")),
        pa.field("markers", _i64, False),
        *(
            pa.field(name, _f64)
            for name in ("reprojection_before_px", "reprojection_px", "depth_before_mm", "depth_mm")
        ),
        *(pa.field(name, _f64) for name in ("sigma_mm", "sigma_deg")),
    ]
)
"""Camera columns are those of the table `views` of a dataset, the board frame being the world; `before` is by markers alone.

T_world_cam is null where no pose could be estimated; sigma_mm, sigma_deg are the largest standard deviation of the camera's
place and direction in any direction.
"""


def pose_rows(estimates: Estimates, camera: CaptureCamera) -> list[Row]:
    """The rows in order of estimate and number."""
    before = estimates.by_markers
    return [
        _row(view, before.get(view.number), camera) | {"estimate": name, "chosen": name == estimates.chosen}
        for name, estimate in estimates.by_name.items()
        for view in estimate.views
    ]


def pose_table(estimates: Estimates, camera: CaptureCamera) -> bytes:
    """The rows as a Parquet file."""
    sink = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(pose_rows(estimates, camera), SCHEMA), sink, compression="zstd")
    return sink.getvalue()


def _row(view: ViewEstimate, before: ViewEstimate | None, camera: CaptureCamera) -> Row:
    T = np.eye(4) if view.T_board_cam is None else view.T_board_cam
    columns = camera_columns(Camera(camera.intrinsics, T))
    if view.T_board_cam is None:
        columns["T_world_cam"] = None
    sigma_mm, sigma_deg = _sigmas(view)
    return {
        **columns,
        "number": view.number,
        "status": view.status,
        "reasons": list(view.reasons),
        "markers": view.markers,
        "reprojection_before_px": None if before is None else before.reprojection_px,
        "reprojection_px": view.reprojection_px,
        "depth_before_mm": None if before is None else before.depth_mm,
        "depth_mm": view.depth_mm,
        "sigma_mm": sigma_mm,
        "sigma_deg": sigma_deg,
    }


def _sigmas(view: ViewEstimate) -> tuple[float | None, float | None]:
    if view.covariance is None:
        return None, None
    place, turn = (
        float(np.linalg.eigvalsh(block).max()) for block in (view.covariance[:3, :3], view.covariance[3:, 3:])
    )
    return 1e3 * float(np.sqrt(max(place, 0.0))), float(np.degrees(np.sqrt(max(turn, 0.0))))
