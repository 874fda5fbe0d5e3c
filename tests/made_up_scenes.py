"""Scenes with made-up files and rows, quick and deterministic, for tests of the store."""

import dataclasses
import hashlib
from collections.abc import Callable

import numpy as np

from schemas.dataset.commit import CommitTerms, Span
from schemas.dataset.layout import IMAGES, asset_path, file_pose_id, image_path, input_pose_id, patch_path
from schemas.dataset.tables import OF_TARGETS
from schemas.scene.scene import EncodedFile, SceneOutput, encoded_file
from schemas.scene.view import MODALITIES
from workers.store.attempt import Attempt, begin_attempt
from workers.store.store import Store

CATEGORIES = ("bottle", "camera", "mug")
TERMS = CommitTerms(job_digest="j" * 64, fingerprint="stack-a", range_size=4, pairs_per_scene=1)


PLAIN = tuple(image for image in IMAGES if MODALITIES[image.pixels].target is None)
"""The images of a job without targets."""


def terms(**changes) -> CommitTerms:
    return TERMS.model_copy(update=changes)


def numbers_of(*keys: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(7, spawn_key=keys))


def bytes_of(path: str, size: int = 200) -> bytes:
    """Bytes that differ for every path."""
    return b"".join(hashlib.sha256(f"{path}{i}".encode()).digest() for i in range(-(-size // 32)))[:size]


def matrix_of(*keys: int) -> list[float]:
    return [*numbers_of(*keys).normal(size=12).tolist(), -0.0, 0.0, 0.0, 1.0]


def with_shapes(output: SceneOutput, change: Callable[[bytes], bytes]) -> SceneOutput:
    """The scene with other bytes in its shapes."""
    files = (
        encoded_file(file.path, change(file.data)) if file.path.startswith("assets/") else file for file in output.files
    )
    return dataclasses.replace(output, files=tuple(files))


def category_of(scene_id: int) -> str:
    return CATEGORIES[int(numbers_of(scene_id).integers(len(CATEGORIES)))]


def made_scene(scene_id: int, salt: str = "", images=PLAIN, shapes: bool = True) -> SceneOutput:
    """A scene without failure; `salt` changes its images, as another software stack would; `images` are those it has."""
    category = category_of(scene_id)
    pose_id = input_pose_id(scene_id, 0, 1)
    files: list[EncodedFile] = []
    by_role: dict[str, list[dict[str, object]]] = {}
    for image in images:
        for name in (image_path, patch_path):
            path = name(category, image.content, file_pose_id(image.role, pose_id))
            file = encoded_file(path, bytes_of(path + salt, 100 + scene_id % 7))
            files.append(file)
            row = {"path": file.path, "bytes": len(file.data), "sha256": file.sha256}
            by_role.setdefault(image.role, []).append(row)
    instance, table = f"{category}-{scene_id % 3}", "table-0"
    if shapes:
        files.append(encoded_file(asset_path(category, instance), bytes_of(instance, 300)))
    views = [_view(scene_id, category, pose_id, role, rows) for role, rows in by_role.items()]
    objects = [
        _object(view, region, *thing)
        for view in views
        for region, thing in ((2, ("table", table)), (3, (category, instance)))
    ]
    return SceneOutput(
        scene_id=scene_id,
        files=tuple(files),
        rows={
            "scenes": [_scene(scene_id, category, instance, table)],
            "views": views,
            "objects": objects,
            "assets": [_asset(category, instance, shapes), _asset("table", table, False)],
            "timings": [timing(scene_id, category)],
        },
    )


def failed_scene(scene_id: int, kind: str = "intrinsic") -> SceneOutput:
    category = category_of(scene_id)
    row = {
        "scene_id": scene_id,
        "category": category,
        "stage": "settle",
        "kind": kind,
        "reason": "left_table" if kind == "intrinsic" else "killed",
        "detail": "it fell",
        "attempts": 1 if kind == "intrinsic" else 3,
    }
    return SceneOutput(scene_id=scene_id, files=(), rows={"failures": [row], "timings": [timing(scene_id, category)]})


def fails(scene_id: int) -> bool:
    """Whether a scene fails: every eleventh does."""
    return scene_id % 11 == 5


def scene(scene_id: int) -> SceneOutput:
    """The scene, made or failed, the same in every call."""
    return failed_scene(scene_id) if fails(scene_id) else made_scene(scene_id)


def small_scene(scene_id: int) -> SceneOutput:
    """The scene with two images and their patches only."""
    return failed_scene(scene_id) if fails(scene_id) else made_scene(scene_id, images=(PLAIN[0], PLAIN[6]))


def attempt_at(store: Store, start: int, stop: int, settings: CommitTerms = TERMS, make=scene, **span) -> Attempt:
    """An attempt with all its scenes added, ready to commit."""
    attempt = begin_attempt(store, Span(start=start, stop=stop, **span), settings)
    for scene_id in attempt.span.scene_ids:
        attempt.begin_scene(scene_id)
        attempt.add_scene(make(scene_id))
    return attempt


def timing(scene_id: int, category: str) -> dict[str, object]:
    """A row of timings that differs in every call, as clocks do."""
    seconds = float(np.random.default_rng().uniform())
    stages = [{"name": "settle", "seconds": seconds}]
    return {"scene_id": scene_id, "category": category, "stages": stages, "effects": [], "total_s": seconds}


def _scene(scene_id: int, category: str, instance: str, table: str) -> dict[str, object]:
    first = {"category": category, "instance_id": instance, "source": "procedural", "table_id": table}
    effects = {"effects": ["drop", "snap"], "skipped": [{"effect": "tip", "why": "stands"}]}
    return (
        {"scene_id": scene_id, **first, "object_scale": 0.25, "pose": "upright", "redraws": scene_id % 3}
        | {"T_world_obj": matrix_of(scene_id, 1), "T_world_table": matrix_of(scene_id, 2)}
        | {**effects, **_rest(scene_id), "settle_s": 0.7, "raycast_checked": scene_id % 2 == 0}
        | {"settings_digest": "d" * 64, "surroundings": None, "capture": None}
        | {"bodies": [_body(scene_id, region, category, instance) for region in (3, 4)]}
    )


def _rest(scene_id: int) -> dict[str, object]:
    """The columns of a body's rest; a scene's are the worst of its bodies', which are equal here."""
    recheck = (None, None) if scene_id % 2 else (0.02, 0.01)
    return {"penetration_mm": 0.01, "hover_gap_mm": -0.0, "support_margin_mm": 12.5, "residual_speed_mm_s": 0.1} | {
        "recheck_move_mm": recheck[0],
        "recheck_turn_deg": recheck[1],
        "equilibrium_residual": 0.001,
    }


def _body(scene_id: int, region: int, category: str, instance: str) -> dict[str, object]:
    """A body's columns; the first object has those of the scene."""
    point = {"point": [0.01 * region, 0.0, 0.75], "normal": [0.0, 0.0, 1.0], "force": [0.0, 0.0, 4.905]}
    return (
        {"region_id": region, "category": category, "instance_id": instance, "source": "procedural"}
        | {"object_scale": 0.25, "T_world_obj": matrix_of(scene_id, 1 if region == 3 else region)}
        | {
            "redraws": scene_id % 3,
            **_rest(scene_id),
            "mass_kg": 0.5,
            "friction": None,
            "com": [0.01 * region, 0.0, 0.8],
        }
        | {"contacts": [{"with_region": 2, **point}]}
    )


def _view(scene_id: int, category: str, pose_id: int, role: str, files: list[dict[str, object]]) -> dict[str, object]:
    filled, hidden = (0.5, 0.4) if role == "projected" else (None, None)
    return (
        {"pose_id": pose_id + 1 if role == "mirror" else pose_id, "parent_id": pose_id, "role": role}
        | {"number": None}
        | {"scene_id": scene_id, "category": category, "T_world_cam": matrix_of(scene_id, 3, len(role))}
        | {"inclination_rad": 0.8, "yaw_rad": 1.0 / 3.0, "width": 640, "height": 480, "fx": 525.0, "fy": 525.0}
        | {"cx": 320.0, "cy": 240.0, "cx_opencv": 319.5, "cy_opencv": 239.5, "depth_units_per_m": 5000.0, "d_z_m": 2.4}
        | {"files": files, "object_pixels": 530, "visible_fraction": 1.0, "patch_object_fraction": None}
        | {"projected_filled_share": filled, "projected_hidden_share": hidden, "capture": None}
        | {"mirror_agreement": {"median_mm": 0.06, "share": 0.99} if role == "mirror" else None}
    )


def _object(view: dict, region: int, category: str, instance: str) -> dict[str, object]:
    return (
        {name: view[name] for name in ("pose_id", "role", "number", "scene_id")}
        | {"region_id": region, "category": category, "instance_id": instance, "u": 300 + region, "v": -1}
        | {"T_cam_obj": matrix_of(view["scene_id"], 4, region), "bbox_xywh": [1, 2, 3, 4], "pixels": 500}
        | {"visible_fraction": 0.9, "patch_object_fraction": None if region == 2 else 0.3}
        | dict.fromkeys(OF_TARGETS["objects"])
    )


def _asset(category: str, instance: str, shapes: bool) -> dict[str, object]:
    return (
        {"instance_id": instance, "category": category, "source": "procedural", "licence": "CC0-1.0"}
        | {"path": f"models/{instance}.obj" if shapes else None, "extents_m": [0.1, 0.2, 1 / 3], "volume_m3": None}
        | {"sha256": hashlib.sha256(instance.encode()).hexdigest(), "watertight": False, "scale": 1.0}
        | {"T_source_to_object": matrix_of(len(instance)), "split": "train", "notes": []}
        | dict.fromkeys(OF_TARGETS["assets"])
    )
