"""Cameras, labels and projection of stored scenes, and their shapes, by the definitions of Staszak and Belter 2024.

Matrices are [4, 4] float64, `T_a_b` takes frame b to frame a, metres; camera frames are optical (x right, y down, z
forward). A pixel (column, row) has its centre at (column + 0.5, row + 0.5).
"""

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from services.read.independent.cameras import Stand, sensor_of
from services.read.independent.rays import Array, Faces, Row, bare_faces, place_shapes, read_shape

ROUNDING = 1e-9
"""Largest difference of poses, distances and angles (metres, radians) between two orders of the same arithmetic."""

EDGE_PX = 1e-6
"""An origin as near as this to the edge of a pixel may be counted on either side: the table's often lies on one."""

FLOOR_SHARE = 2e-5
"""Largest height of a floor pixel, as a share of its depth, beyond what rounding of stored depth explains.

Depth in float32 leaves 2e-6; half a pixel at a focal length of 525 pixels is 1e-3.
"""

TIE_M = 1e-12
"""Two projected points as near to each other as this in z are tied: which is nearer is a matter of rounding."""

MOST_BROKEN_TIES = 0.25
"""Share of tied pixels that may show another point: rounding breaks some 4 %, another rule more than half."""

FLOOR_M = 1e4
"""Half the side of a floor, or of a capture's board, which are in no file: planes, whose colour is not judged."""

FLOOR, TABLE, FIRST_OBJECT, FIRST_CLUTTER = 1, 2, 3, 200


def name_of(row: Row) -> str:
    """The name of a view within its pair, of a row of `views` or `objects`: its role, of a camera by name `around_003`."""
    return row["role"] if row["number"] is None else f"{row['role']}_{row['number']:03d}"


def beside(job: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The branches of the cameras beside the input camera, by the role of their views."""
    cameras = job["cameras"].items()
    return {"aligned" if name == "depth" else name: branch for name, branch in cameras if "offset_m" in branch}


@dataclass(frozen=True)
class Kind:
    """A kind of pixel that the job stores of a view, as the table of modalities says."""

    name: str
    word: str
    """The content word in the file's name."""
    dtype: str
    channels: int
    each: bool
    """An image for each object."""
    formula: str | None
    """The formula of `targets.py` that gives its values; None where there is none of this name."""


@dataclass(frozen=True)
class StoredPair:
    """The job's keys, the rows of one pair (views by name), and a function that reads a file by its path."""

    job: Mapping[str, Any]
    scene: Row
    views: Mapping[str, Row]
    objects: Sequence[Row]
    read: Callable[[str], bytes]
    stored: Mapping[str, Sequence[Kind]]
    """By role, what the job stores of a view."""
    images: dict[tuple[str, str], NDArray] = field(default_factory=dict)
    """Decoded images by the view's name and kind of pixel."""
    shapes: dict[str, Any] = field(default_factory=dict)
    """Shapes that were read, by path; `floor`, which is in no file, where it is known."""
    findings: list[Any] = field(default_factory=list)
    """Findings of targets, of every view."""
    absent: list[str] = field(default_factory=list)
    """Why targets were not judged: shapes that are not stored."""
    given: tuple[Sequence[tuple[str | None, Array | None]], Sequence[Array]] | None = None
    """Instances and poses of objects, and poses of cameras, that the table of scenes has; None where it is not at hand."""

    stands: Mapping[str, Sequence[Stand]] = field(default_factory=dict)
    """Rows of tables of poses that are at hand, by camera."""

    @property
    def is_captured(self) -> bool:
        """Whether the input view is a photograph: it stands where it was taken, by a camera of its own."""
        return self.job.get("captures") is not None

    @property
    def is_studio(self) -> bool:
        """Whether the object stands alone: there is no table and no floor, and nothing holds it."""
        return bool(self.job.get("scene") == "studio")

    @property
    def has_given_cameras(self) -> bool:
        """Whether a table of scenes has the input cameras, or may have them."""
        if not self.job.get("scenes_from") or self.job["cameras"]["orbit"].get("always"):
            return False
        return self.given is None or bool(self.given[1])

    @property
    def named(self) -> dict[str, Mapping[str, Any]]:
        """The job's further cameras by name."""
        return {entry["name"]: entry for entry in self.job["cameras"].get("more", ())}

    def labels(self, view: Row) -> dict[int, Row]:
        """The rows of `objects` of a view, by region."""
        return {row["region_id"]: row for row in self.objects if name_of(row) == name_of(view)}

    def sensor(self, view: Row) -> Mapping[str, Any]:
        """The pinhole camera of a view: the job's, or the input view's; nothing where a table not at hand may say it.

        The latter of captures, where a table of scenes has the cameras, and where numbers are drawn from ranges, of which
        cameras that stand by themselves have the middle.
        """
        job_sensor, entry = self.job["cameras"]["sensor"], self.named.get(view["role"])
        sensor = {name: np.mean(value).item() for name, value in job_sensor.items()}
        own = self.has_given_cameras or bool(ranges_of(job_sensor))
        if self.is_captured or (own and (entry is None or entry["beside"])):
            sensor = {name: self.views["input"][name] for name in sensor}
        if entry is None or not entry["poses"]:
            return sensor if entry is None else sensor_of(entry, sensor)
        row = self.stands.get(entry["name"], ())[view["number"] : view["number"] + 1]
        return (row[0].pinhole or sensor_of(entry, sensor)) if row else {}

    @property
    def targets(self) -> Mapping[str, Any]:
        """The job's branch `targets`, which one without any has not."""
        return self.job.get("targets") or {"views": (), "smooth": False}

    @property
    def bodies(self) -> Sequence[Row]:
        """region_id, category, instance_id and T_world_obj of the objects; the one of a capture is in the scene's own columns."""
        return self.scene["bodies"] or [{**self.scene, "region_id": FIRST_OBJECT}]

    @property
    def surroundings(self) -> Mapping[str, Any]:
        """What was drawn of `look`; empty where a job asks for nothing."""
        return self.scene["surroundings"] or {}

    @property
    def clutter(self) -> list[Row]:
        """Objects that have no rows of their own: region_id, category, instance_id and T_world_obj."""
        return list(self.surroundings.get("clutter", ()))

    @property
    def regions(self) -> list[int]:
        """Region ids of the objects."""
        return [body["region_id"] for body in self.bodies]

    def kinds(self, role: str) -> dict[str, Kind]:
        """Kinds of pixel that the job stores of a view; `amodal3`, `amodal4` of one that each object has."""
        return {
            name: kind
            for kind in self.stored[role]
            for name in ([f"{kind.name}{region}" for region in self.regions] if kind.each else [kind.name])
        }

    def path(self, view: Row, kind: str, patch_of: int | None = None) -> str:
        """`mug/depth00000.png`; of a patch, and of an object's own image, with the object's number where there are several.

        The mirror camera's own images have the mirror's odd id, all others the input's.
        """
        number = view["parent_id"] + (view["role"] == "mirror")
        own = own_region(kind)
        word = self.kinds(view["role"])[kind].word
        region = patch_of or own
        suffix = "" if view["number"] is None else f"_{view['number']:03d}"
        suffix += f"obj{region - FIRST_OBJECT}" if region and len(self.regions) > 1 else ""
        return f"{view['category']}/{'patches/' if patch_of else ''}{word}{number:05d}{suffix}.png"


def faces_of(pair: StoredPair, view: Row) -> Faces:
    """Floor, table and objects, or board and object, in the camera's frame. Raises FileNotFoundError without a shape's file.

    Targets of a capture are of the stored corners, and not of those before rounding.
    """
    T_cam_world = np.asarray(np.linalg.inv(matrix(view, "T_world_cam")), np.float64)
    plane = TABLE if pair.is_captured else FLOOR
    placed = [] if pair.is_studio else [(plane, pair.shapes.get("floor") or _plane(), T_cam_world)]
    return place_shapes(placed + [(region, shape, T_cam_world @ T) for region, shape, T in things_of(pair)])


def things_of(pair: StoredPair) -> list[tuple[int, Faces, Array]]:
    """The table, where there is one, and the objects: (region, shape, pose [4, 4] in the world). Raises as `faces_of`."""
    scene, things = pair.scene, list[tuple[int, Faces, Array]]()
    table = {"region_id": TABLE, "category": "table", "instance_id": scene["table_id"]}
    on_table = not pair.is_captured and not pair.is_studio
    for body in (*([table] if on_table else []), *pair.bodies, *pair.clutter):
        path = f"assets/{body['category']}/{body['instance_id']}.glb"
        if path not in pair.shapes:
            shape = read_shape(pair.read(path))
            rounding_m = shape.rounding_m * (not pair.is_captured)
            pair.shapes[path] = replace(shape, rounding_m=rounding_m)
        T_world = matrix(scene, "T_world_table") if body is table else matrix(body, "T_world_obj")
        things.append((body["region_id"], pair.shapes[path], T_world))
    return things


def _plane() -> Faces:
    """A floor or a board, without a colour."""
    corners = FLOOR_M * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    points = corners[[[0, 1, 2], [0, 2, 3]]]
    return replace(bare_faces(points), normals=np.broadcast_to([0.0, 0.0, 1.0], points.shape))


def of_objects(region: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Whether region ids are of objects with rows."""
    return (region >= FIRST_OBJECT) & (region < FIRST_CLUTTER)


def own_region(kind: str) -> int | None:
    """The object that a kind of pixel is of, where each object has an image of its own."""
    return int(kind.removeprefix("amodal")) if kind.startswith("amodal") else None


def check_images(pair: StoredPair, view: Row) -> Iterator[str]:
    """Decode the view's images; type, size, and every file's size and digest in its row."""
    size = (view["height"], view["width"])
    for name, kind in pair.kinds(view["role"]).items():
        path = pair.path(view, name)
        image = pair.images[name_of(view), name] = _decode(pair.read(path))
        shape = size if kind.channels == 1 else (*size, kind.channels)
        if image.dtype != np.dtype(kind.dtype) or image.shape != shape:
            yield f"{path}: is {image.dtype} {image.shape}, and must be {kind.dtype} {shape}"
    for file in view["files"]:
        data = pair.read(file["path"])
        if (len(data), hashlib.sha256(data).hexdigest()) != (file["bytes"], file["sha256"]):
            yield f"{file['path']}: bytes or sha256 in views are not the file's"


def ranges_of(sensor: Mapping[str, Any]) -> dict[str, Sequence[float]]:
    """[least, most] of the numbers of a job's sensor that are drawn."""
    return {name: value for name, value in sensor.items() if isinstance(value, list)}


def _check_drawn(ranges: Mapping[str, Sequence[float]], view: Row) -> Iterator[str]:
    """Numbers of an input view that are drawn lie in their ranges; those of fx and fy as far along."""
    shares = {}
    for name, (least, most) in ranges.items():
        if not least <= view[name] <= most:
            yield f"{name} is {view[name]}, the job gives {least} to {most}"
        shares[name] = (view[name] - least) / (most - least) if most > least else None
    fx, fy = (shares.get(name) for name in ("fx", "fy"))
    if fx is not None and fy is not None and abs(fx - fy) > ROUNDING:
        yield f"fx and fy are {fx:.6f} and {fy:.6f} of the way along their ranges, and must be as far"


def check_camera(pair: StoredPair, view: Row) -> Iterator[str]:
    """Ids, intrinsics in both conventions, a rigid pose, and its angles."""
    pairs, sensor, parent = pair.job["pairs_per_scene"], pair.sensor(view), view["parent_id"]
    first = 2 * pairs * pair.scene["scene_id"]
    if parent not in range(first, first + 2 * pairs, 2) or view["pose_id"] != parent + (view["role"] == "mirror"):
        yield f"ids {view['pose_id']} and {parent} do not follow from scene {pair.scene['scene_id']}"
    units = pair.job["images"]["depth_units_per_m"]
    derived = {"cx_opencv": view["cx"] - 0.5, "cy_opencv": view["cy"] - 0.5, "depth_units_per_m": units}
    for name, value in {**derived, **sensor}.items():
        if abs(view[name] - value) > 1e-12 * abs(value):
            yield f"{name} is {view[name]}, the {'input view' if pair.is_captured else 'job'} gives {value}"
    if view["role"] == "input" and not pair.is_captured and not pair.has_given_cameras:
        yield from _check_drawn(ranges_of(pair.job["cameras"]["sensor"]), view)
    T = matrix(view, "T_world_cam")
    R, axis = T[:3, :3], T[:3, 2]
    if distance(R.T @ R, np.eye(3)) > ROUNDING or np.linalg.det(R) < 0 or list(T[3]) != [0, 0, 0, 1]:
        yield "T_world_cam is no rigid transform"
    if abs(math.sin(view["inclination_rad"]) + axis[2]) > ROUNDING:
        yield f"inclination_rad {view['inclination_rad']} is not the angle of the optical axis below the horizontal"
    level = math.hypot(axis[0], axis[1])
    direction = level * np.array([math.cos(view["yaw_rad"]), math.sin(view["yaw_rad"])])
    if level > ROUNDING and distance(direction, -axis[:2]) > ROUNDING:
        yield f"yaw_rad {view['yaw_rad']} is not the direction from the table to the camera"


def check_depth(pair: StoredPair, view: Row) -> Iterator[str]:
    """Depth is z in units within the stored range, none where nothing was hit; floor pixels lie at height 0."""
    depth, region = pair.images[name_of(view), "depth"], pair.images[name_of(view), "region"]
    units, (low, high) = view["depth_units_per_m"], pair.job["images"]["depth_range_m"]
    some = depth[depth > 0]
    if len(some) and not (low * units - 0.5 <= some.min() and some.max() <= high * units + 0.5):
        yield f"depth from {some.min() / units} to {some.max() / units} m is outside images.depth_range_m"
    if (depth[region == 0] > 0).any() and not pair.is_captured:
        yield "depth where the mask says that nothing was hit"
    points, _ = unproject(view, np.where((region == FLOOR) & ~on_walls(pair, view), depth, 0))
    if points.shape[1] and not pair.job["sensor"]["depth_noise"]:
        up = matrix(view, "T_world_cam")[2]
        rounding = 0.5 / units * np.abs(up[:3] @ (points[:3] / points[2]))
        height_m = np.abs(up @ points)
        if (height_m - rounding > FLOOR_SHARE * points[2]).any():
            yield f"floor pixels lie up to {height_m.max() * 1e3:.3f} mm off the floor's plane"


BEFORE_WALL_M, BEHIND_WALL_M = 0.05, 0.11
"""What stands before the inner face of a wall, as a window does, and how thick it is."""


def on_walls(pair: StoredPair, view: Row) -> NDArray[np.bool_]:
    """[H, W]: pixels of the floor's region that show a room's walls, or lie too far away to be stored."""
    depth, region = pair.images[name_of(view), "depth"], pair.images[name_of(view), "region"]
    shown = np.zeros(region.shape, np.bool_)
    if (size_m := pair.surroundings.get("room_m")) is None:
        return shown
    points, pixels = unproject(view, np.where(region == FLOOR, depth, 0))
    x, y, z, _ = np.abs(matrix(view, "T_world_cam") @ points)
    beyond = np.maximum(x - size_m[0] / 2, y - size_m[1] / 2)
    shown.reshape(-1)[pixels] = (beyond > -BEFORE_WALL_M) & (beyond < BEHIND_WALL_M) & (z < size_m[2] + 1e-3)
    return shown | ((region == FLOOR) & (depth == 0))


def check_labels(pair: StoredPair, view: Row) -> Iterator[str]:
    """Regions, pixel counts, boxes, object poses and image coordinates."""
    region, labels = pair.images[name_of(view), "region"], pair.labels(view)
    poses = {body["region_id"]: matrix(body, "T_world_obj") for body in pair.bodies}
    if not pair.is_studio:
        poses[TABLE] = matrix(pair.scene, "T_world_table")
    if labels.keys() != poses.keys() or not set(np.unique(region).tolist()) <= {
        *(0, FLOOR, *poses),
        *(body["region_id"] for body in pair.clutter),
    }:
        yield f"regions are {sorted(labels)} in objects, {sorted(poses)} in scenes, {np.unique(region)} in the mask"
        return
    rgb = pair.images.get((name_of(view), "rgb"), region)
    if (
        rgb.ndim == 3
        and rgb.shape[2] == 4
        and ((rgb[..., 3] == 0) & (region > 0) | (rgb[..., 3] == 255) & (region == 0)).any()
    ):
        yield "alpha is 0 where the mask shows something, or 255 where it does not"
    if view["object_pixels"] != np.count_nonzero(of_objects(region)):
        yield f"object_pixels {view['object_pixels']} is not the number of pixels of objects"
    for number, label in labels.items():
        T = np.linalg.inv(matrix(view, "T_world_cam")) @ poses[number]
        x, y, width, height = cv2.boundingRect((region == number).astype(np.uint8))
        for name, value in {"pixels": np.count_nonzero(region == number), "bbox_xywh": [x, y, width, height]}.items():
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
    return inside and max(abs(u - label["u"] - 0.5), abs(v - label["v"] - 0.5)) <= 0.5 + EDGE_PX


def check_patches(pair: StoredPair, view: Row) -> Iterator[str]:
    """Each patch is the crop centred on an object's (u, v), and is left out where it would leave the image.

    Views of further cameras have none.
    """
    role, size = view["role"], pair.job["images"]["patch"]
    seen_from = pair.views["mirror" if role == "projected" else name_of(view)]
    labels = [
        row for region, row in pair.labels(seen_from).items() if region >= FIRST_OBJECT and role not in pair.named
    ]
    stored = {file["path"] for file in view["files"]}
    expected = {pair.path(view, kind) for kind in pair.kinds(role)}
    for label in labels:
        left, top = label["u"] - size["width"] // 2, label["v"] - size["height"] // 2
        right, bottom = left + size["width"], top + size["height"]
        whole = left >= 0 and top >= 0 and right <= view["width"] and bottom <= view["height"]
        if label["u"] < 0 or label["pixels"] == 0 or not whole:
            continue
        for kind in (kind for kind in pair.kinds(role) if own_region(kind) in (None, label["region_id"])):
            path = pair.path(view, kind, label["region_id"])
            expected.add(path)
            crop = pair.images[name_of(view), kind][top:bottom, left:right]
            if path in stored and not np.array_equal(_decode(pair.read(path)), crop):
                yield f"{path} is not the crop about ({label['u']}, {label['v']})"
    if different := expected ^ stored:
        yield f"the files {sorted(different)} should be there, or should not"


def check_projection(pair: StoredPair) -> Iterator[str]:
    """The stored input cloud in the mirror camera: pixel is floor(u, v), the nearest z wins, ties go to the lowest index."""
    source, target = pair.views["input"], pair.views["projected"]
    points, index = unproject(source, pair.images["input", "depth"])
    points = np.linalg.inv(matrix(target, "T_world_cam")) @ matrix(source, "T_world_cam") @ points
    (x, y, z, _), index = points[:, points[2] > 0], index[points[2] > 0]
    u, v = np.floor(target["fx"] * x / z + target["cx"]), np.floor(target["fy"] * y / z + target["cy"])
    inside = (u >= 0) & (u < target["width"]) & (v >= 0) & (v < target["height"])
    pixel, z, index = (v * target["width"] + u)[inside].astype(np.int64), z[inside], index[inside]
    stored = pair.images["projected", "depth"].ravel()
    nearest, lowest = np.full(stored.shape, np.inf), np.full(stored.shape, source["width"] * source["height"])
    np.minimum.at(nearest, pixel, z)
    tied = z - nearest[pixel] <= TIE_M
    np.minimum.at(lowest, pixel[tied], index[tied])
    low, high = pair.job["images"]["depth_range_m"]
    expected = np.where((nearest > low) & (nearest < high), np.rint(nearest * target["depth_units_per_m"]), 0)
    if wrong := np.count_nonzero(stored != expected):
        yield f"{wrong} depth pixels are not those of the input cloud"
    if abs(target["projected_filled_share"] - np.count_nonzero(stored) / stored.size) > ROUNDING:
        yield f"projected_filled_share is {target['projected_filled_share']}, and not the share of pixels with depth"
    if ("projected", "rgb") not in pair.images or pair.job["sensor"]["distortion"]:
        return
    sent, carried = pair.images["input", "rgb"], pair.images["projected", "rgb"]
    channels = carried.shape[2]
    colours = np.concatenate([sent.reshape(-1, channels), np.zeros((1, channels), np.uint8)])
    differs = (colours[lowest] != carried.reshape(-1, channels)).any(axis=1)
    several = np.bincount(pixel[tied], minlength=stored.size) > 1
    if plain := np.count_nonzero(differs & ~several):
        yield f"{plain} colours are not those of the nearest points"
    broken, ties = np.count_nonzero(differs & several), np.count_nonzero(several)
    if broken > MOST_BROKEN_TIES * ties:
        yield f"{broken} of {ties} ties do not go to the lowest source index"


def _decode(data: bytes) -> NDArray:
    """[H, W], [H, W, 3] RGB or [H, W, 4] RGBA; empty where the bytes are no image."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim < 3:
        return np.zeros(0) if image is None else image
    return image[..., [2, 1, 0, 3][: image.shape[2]]]


def matrix(row: Row, name: str) -> Array:
    """[4, 4] of a column."""
    return np.array(row[name], np.float64).reshape(4, 4)


def distance(a: Array, b: Array) -> float:
    """Largest difference of two arrays' elements."""
    return float(np.abs(a - b).max())


def unproject(view: Row, depth: NDArray) -> tuple[Array, NDArray[np.int64]]:
    """([4, N] homogeneous points in the camera's frame of the pixels that have depth, their flat indices [N])."""
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns] / view["depth_units_per_m"]
    x, y = (columns + 0.5 - view["cx"]) / view["fx"] * z, (rows + 0.5 - view["cy"]) / view["fy"] * z
    return np.stack([x, y, z, np.ones_like(z)]), rows * view["width"] + columns
