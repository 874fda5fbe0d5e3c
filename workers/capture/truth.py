"""What a simulation knows of its capture, for evaluation alone: truth/ in the capture's folder.

truth.json       poses, print scale, depth camera, lens, receipt of effects
mesh.glb         the true object in its own frame, metres, z up
mask_00000.png   the object's true pixels of each view
held_out/        exact views from other poses, a folder like a capture's
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import Frozen, frozen_array
from schemas.capture import CaptureTruth
from schemas.job.views import Distortion
from schemas.scene.scene import EffectPlan
from schemas.scene.shape import Asset
from workers.capture.folder import Matrix, read_json
from workers.store.images import encode_mask

TRUTH, TRUTH_FILE, MESH_FILE, HELD_OUT = "truth", "truth.json", "mesh.glb", "held_out"


class TruthFile(Frozen):
    """truth.json: a `CaptureTruth`, the object's names, and which effects ran, and why the others did not."""

    object: dict[str, str]
    T_board_cam: list[Matrix]
    T_board_obj: Matrix
    print_scale: float
    T_color_depth: Matrix
    depth_bias_m: float
    lens: Distortion | None
    effects: list[str]
    skipped: list[dict[str, str]]
    surroundings: dict[str, Any] | None = None


def write_truth(
    path: Path, truth: CaptureTruth, asset: Asset, plan: EffectPlan, surroundings: Mapping[str, object] | None = None
) -> None:
    """Writes truth.json and mesh.glb below a capture's folder; `surroundings`: what was drawn of `look`."""
    from workers.assets.glb import asset_glb  # loads trimesh, which a run that lists captures has no use for

    arrays = {name: getattr(truth, name).tolist() for name in ("T_board_cam", "T_board_obj", "T_color_depth")}
    record = TruthFile(
        object={"category": asset.category, "instance_id": asset.instance_id, "mesh": MESH_FILE},
        print_scale=truth.print_scale,
        depth_bias_m=truth.depth_bias_m,
        lens=truth.lens,
        effects=list(plan.ran),
        skipped=[{"effect": name, "why": why} for name, why in plan.skipped.items()],
        surroundings=dict(surroundings) if surroundings else None,
        **arrays,
    )
    folder = path / TRUTH
    folder.mkdir(exist_ok=True)
    (folder / MESH_FILE).write_bytes(asset_glb(asset))
    without = None if surroundings else {"surroundings"}
    (folder / TRUTH_FILE).write_text(record.model_dump_json(indent=1, exclude=without) + "\n", encoding="utf-8")


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
    spec = read_json(file, TruthFile)
    T_board_cam = frozen_array(spec.T_board_cam).reshape(-1, 4, 4)
    poses = T_board_cam, frozen_array(spec.T_board_obj), spec.print_scale, frozen_array(spec.T_color_depth)
    return CaptureTruth(*poses, spec.depth_bias_m, spec.lens)


def read_receipt(path: Path) -> tuple[list[str], list[dict[str, str]], dict[str, Any] | None]:
    """(effects that ran, [{effect, why}] of those that did not, what was drawn of `look`) of a simulated capture's folder."""
    spec = read_json(path / TRUTH / TRUTH_FILE, TruthFile)
    return spec.effects, spec.skipped, spec.surroundings
