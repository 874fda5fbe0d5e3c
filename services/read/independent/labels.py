"""Labels by their definitions: depth on the floor's plane, masks, boxes, image coordinates, object poses and patches."""

import math
from collections.abc import Iterator

import numpy as np

from services.read.independent.pair import (
    FIRST_OBJECT,
    FLOOR,
    ROUNDING,
    TABLE,
    Array,
    Row,
    StoredPair,
    decode,
    distance,
    kinds_of,
    matrix,
    path_of,
    unproject,
)

EDGE_PX = 1e-6
"""An origin as near as this to the edge of a pixel may be counted on either side: the table's often lies on one."""

FLOOR_SHARE = 2e-5
"""Largest height of a floor pixel, as a share of its depth, beyond what rounding of stored depth explains.

Depth in float32 leaves 2e-6; half a pixel at a focal length of 525 pixels is 1e-3.
"""


def check_depth(pair: StoredPair, view: Row) -> Iterator[str]:
    """Depth is z in units within the stored range, none where nothing was hit; floor pixels lie at height 0."""
    depth, region = pair.images[view["role"], "depth"], pair.images[view["role"], "region"]
    units, (low, high) = view["depth_units_per_m"], pair.job["images"]["depth_range_m"]
    some = depth[depth > 0]
    if len(some) and not (low * units - 0.5 <= some.min() and some.max() <= high * units + 0.5):
        yield f"depth from {some.min() / units} to {some.max() / units} m is outside images.depth_range_m"
    if (depth[region == 0] > 0).any():
        yield "depth where the mask says that nothing was hit"
    points, _ = unproject(pair, view, region == FLOOR)
    if points.shape[1] and not pair.job["sensor"]["depth_noise"]:
        up = matrix(view, "T_world_cam")[2]
        rounding = 0.5 / units * np.abs(up[:3] @ (points[:3] / points[2]))
        height_m = np.abs(up @ points)
        if (height_m - rounding > FLOOR_SHARE * points[2]).any():
            yield f"floor pixels lie up to {height_m.max() * 1e3:.3f} mm off the floor's plane"


def check_labels(pair: StoredPair, view: Row) -> Iterator[str]:
    """Regions, pixel counts, boxes, poses, image coordinates and the object's share of its patch."""
    region, scene = pair.images[view["role"], "region"], pair.scene
    bodies = scene["bodies"] or [{"region_id": FIRST_OBJECT, "T_world_obj": scene["T_world_obj"]}]
    poses = {body["region_id"]: matrix(body, "T_world_obj") for body in bodies}
    poses[TABLE] = matrix(scene, "T_world_table")
    labels = {row["region_id"]: row for row in pair.objects if row["role"] == view["role"]}
    if labels.keys() != poses.keys() or not set(np.unique(region).tolist()) <= {0, FLOOR, *poses}:
        yield f"regions are {sorted(labels)} in objects, {sorted(poses)} in scenes, {np.unique(region)} in the mask"
        return
    if view["object_pixels"] != np.count_nonzero(region >= FIRST_OBJECT):
        yield f"object_pixels {view['object_pixels']} is not the number of pixels of objects"
    for number, label in labels.items():
        T = np.linalg.inv(matrix(view, "T_world_cam")) @ poses[number]
        rows, columns = np.nonzero(region == number)
        box = [0, 0, 0, 0]
        if len(rows):
            box = [int(x) for x in (columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1)]
        for name, value in {"pixels": len(rows), "bbox_xywh": box}.items():
            if label[name] != value:
                yield f"region {number}: {name} is {label[name]}, the mask gives {value}"
        if not _shows_origin(view, label, T):
            yield f"region {number}: ({label['u']}, {label['v']}) is not the pixel of the object's origin"
        if not distance(matrix(label, "T_cam_obj"), T) <= ROUNDING:
            yield f"region {number}: T_cam_obj is not inverse(T_world_cam) T_world_obj"


def _shows_origin(view: Row, label: Row, T_cam_obj: Array) -> bool:
    """Whether (u, v) is the pixel of the object's origin, or (-1, -1) where that is behind the camera or outside."""
    x, y, z = T_cam_obj[:3, 3]
    u, v = (view["fx"] * x / z + view["cx"], view["fy"] * y / z + view["cy"]) if z > 0 else (math.nan, math.nan)
    if (label["u"], label["v"]) == (-1, -1):
        return not (EDGE_PX < u < view["width"] - EDGE_PX and EDGE_PX < v < view["height"] - EDGE_PX)
    inside = 0 <= label["u"] < view["width"] and 0 <= label["v"] < view["height"]
    return inside and abs(u - label["u"] - 0.5) <= 0.5 + EDGE_PX and abs(v - label["v"] - 0.5) <= 0.5 + EDGE_PX


def check_patches(pair: StoredPair, view: Row) -> Iterator[str]:
    """Each patch is the crop centred on an object's (u, v), and is left out where it would leave the image."""
    role, size = view["role"], pair.job["images"]["patch"]
    seen_from = "mirror" if role == "projected" else role
    labels = [row for row in pair.objects if row["role"] == seen_from and row["region_id"] >= FIRST_OBJECT]
    expected = {path_of(view, kind) for kind in kinds_of(pair, role)}
    for label in labels:
        left, top = label["u"] - size["width"] // 2, label["v"] - size["height"] // 2
        right, bottom = left + size["width"], top + size["height"]
        whole = left >= 0 and top >= 0 and right <= view["width"] and bottom <= view["height"]
        if label["u"] < 0 or label["pixels"] == 0 or not whole:
            continue
        suffix = f"obj{label['region_id'] - FIRST_OBJECT}" if len(labels) > 1 else ""
        for kind in kinds_of(pair, role):
            path = path_of(view, kind, "patches/", suffix)
            expected.add(path)
            if path in {file["path"] for file in view["files"]}:
                crop = pair.images[role, kind][top:bottom, left:right]
                if not np.array_equal(decode(pair.read(path)), crop):
                    yield f"{path} is not the crop about ({label['u']}, {label['v']})"
    if different := expected ^ {file["path"] for file in view["files"]}:
        yield f"the files {sorted(different)} should be there, or should not"
