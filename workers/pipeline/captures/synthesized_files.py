"""Files of synthesised views: pictures with the names that a capture's have, their poses, and views.json with the shares."""

import json
from pathlib import Path
from typing import Any

from schemas.base import Pose, frozen_array
from schemas.capture.estimate import SynthesizedView
from schemas.errors import CaptureError, OutputError, ViewError
from schemas.scene.view import Camera
from workers.geometry.pixels import round_depth
from workers.pipeline.captures.stored_result import StoredResult
from workers.store.capture_folder import write_pose
from workers.store.images import encode_mask, encode_png

FARTHEST_UNITS = 65_535.0


def write_synthesized(result: StoredResult, T_board_cam: Pose, out: Path, number: int = 0) -> dict[str, Any]:
    """The view from one pose. Returns what is said of it; raises CaptureError where nothing is seen from there."""
    camera = Camera(result.folder.camera.intrinsics, frozen_array(T_board_cam))
    return _finish(result, out, [_write(result, result.views.synthesize(camera), camera, out, number)])[0]


def write_mirrors(result: StoredResult, out: Path) -> list[dict[str, Any]]:
    """The mirror view of every used view, with the number of that view; views that see nothing of the object have none."""
    made = []
    for view in result.estimate.used:
        try:
            camera, d_z, shown = result.views.mirror(view.number)
        except (ViewError, CaptureError):
            continue
        made.append(_write(result, shown, camera, out, view.number) | {"d_z_m": d_z})
    return _finish(result, out, made)


def _write(result: StoredResult, view: SynthesizedView, camera: Camera, out: Path, number: int) -> dict[str, Any]:
    if out.resolve() == result.folder.path.resolve():
        raise OutputError(f"{out} is the capture itself: name another folder")
    out.mkdir(parents=True, exist_ok=True)
    units = result.folder.camera.depth_units_per_m
    depth = round_depth(view.depth_m, 0.0, FARTHEST_UNITS / units, units)
    (out / f"rgb_{number:05d}.png").write_bytes(encode_png(view.rgb))
    (out / f"depth_{number:05d}.png").write_bytes(encode_png(depth))
    (out / f"mask_{number:05d}.png").write_bytes(encode_mask(view.mask))
    (out / f"measured_{number:05d}.png").write_bytes(encode_mask(view.measured))
    write_pose(out / f"board_{number:05d}.txt", camera.T_world_cam)
    return {"name": f"{number:05d}", "measured_share": view.measured_share, "sources": list(view.sources)}


def _finish(result: StoredResult, out: Path, made: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """views.json: the pinhole camera, pixel centres at 0.5, and what is said of each view."""
    if made:
        k = result.folder.camera.intrinsics
        camera = {**k.model_dump(), "pixel_centre": "0.5", "depth_units_per_m": result.folder.camera.depth_units_per_m}
        (out / "views.json").write_text(
            json.dumps({"camera": camera, "views": made}, indent=1) + "\n", encoding="utf-8"
        )
    return made
