"""The folder `truth/` of a simulated capture: what the simulation knows, for evaluation alone.

truth.json       poses, print scale, depth camera, lens, and the receipt of effects
mesh.glb         the true object in its own frame, metres, z up
mask_00000.png   the object's true pixels, 255
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import frozen_array
from schemas.capture.view import CaptureTruth
from schemas.errors import CaptureError
from schemas.job.views import Distortion
from workers.store.capture_folder import TRUTH
from workers.store.images import encode_mask

TRUTH_FILE, MESH_FILE, HELD_OUT = "truth.json", "mesh.glb", "held_out"


@dataclass(frozen=True, eq=False)
class TrueObject:
    """The object of a capture: its asset's names, and its mesh as the bytes of a GLB file in the object frame."""

    category: str
    instance_id: str
    glb: bytes


def write_truth(
    path: Path, truth: CaptureTruth, thing: TrueObject, ran: tuple[str, ...], skipped: Mapping[str, str]
) -> None:
    """Writes truth.json and mesh.glb below a capture's folder; `ran` and `skipped` are the receipt of effects."""
    record = {
        "object": {"category": thing.category, "instance_id": thing.instance_id, "mesh": MESH_FILE},
        "T_board_cam": [T.tolist() for T in truth.T_board_cam],
        "T_board_obj": truth.T_board_obj.tolist(),
        "print_scale": truth.print_scale,
        "T_color_depth": truth.T_color_depth.tolist(),
        "depth_bias_m": truth.depth_bias_m,
        "lens": None if truth.lens is None else truth.lens.model_dump(),
        "effects": list(ran),
        "skipped": [{"effect": name, "why": why} for name, why in skipped.items()],
    }
    folder = path / TRUTH
    folder.mkdir(exist_ok=True)
    (folder / MESH_FILE).write_bytes(thing.glb)
    (folder / TRUTH_FILE).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def write_true_mask(path: Path, number: int, mask: NDArray[np.bool_]) -> None:
    """Writes the object's true pixels [H, W] of one view."""
    folder = path / TRUTH
    folder.mkdir(exist_ok=True)
    (folder / f"mask_{number:05d}.png").write_bytes(encode_mask(mask))


def read_truth(path: Path) -> CaptureTruth | None:
    """What a capture's folder says of its truth; None where it has none. Raises CaptureError where it cannot be read."""
    file = path / TRUTH / TRUTH_FILE
    if not file.exists():
        return None
    try:
        record: dict[str, Any] = json.loads(file.read_bytes())
        lens = record["lens"]
        return CaptureTruth(
            T_board_cam=frozen_array(record["T_board_cam"]).reshape(-1, 4, 4),
            T_board_obj=frozen_array(record["T_board_obj"]).reshape(4, 4),
            print_scale=float(record["print_scale"]),
            T_color_depth=frozen_array(record["T_color_depth"]).reshape(4, 4),
            depth_bias_m=float(record["depth_bias_m"]),
            lens=None if lens is None else Distortion(**lens),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError("unreadable", f"{file} is no truth of a simulated capture: {error!r}") from error


def read_receipt(path: Path) -> tuple[tuple[str, ...], tuple[dict[str, str], ...]]:
    """(names of the effects that ran, [{effect, why}] of those that did not) of a simulated capture's folder."""
    record = json.loads((path / TRUTH / TRUTH_FILE).read_bytes())
    return tuple(record["effects"]), tuple(record["skipped"])
