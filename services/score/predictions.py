"""Edge: the folder of predictions. Which ids it has, and what its files hold; nothing in a file is believed.

    depth/<id>.png (16 bits, units as stored) or .npy (metres)     rgb/<id>.png (8 bits)
    shape/<id>.glb, .ply, .obj (mesh or cloud), .npz (`points` [N, 3])   volume/<id>.npy (a value a stored volume point)
    poses.csv as BOP has it, t in millimetres: im_id is the pose id, obj_id the region; or the three ids are those of `verso
    export --format bop` of the whole dataset

The id is the pose id of the mirror view, as in the names of stored files; leading zeros may be left out. `00001obj1.glb` is
of the second object of a scene, as with stored files.
"""

import csv
import hashlib
import io
import os
import re
import zipfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.errors import InputError, plain_line
from schemas.job.assets import MeshLimits
from schemas.scene.shape import REGION_FIRST_OBJECT, Mesh
from schemas.scene.view import DRAWN_ROLES, Role
from services.score.pose import is_rigid
from workers.door.opening import as_refusal, read_bytes
from workers.geometry.frames import pose
from workers.store.images import decode_png

SUFFIXES: Final = {
    "depth": (".png", ".npy"),
    "rgb": (".png",),
    "shape": (".glb", ".ply", ".obj", ".npz"),
    "volume": (".npy",),
}
"""Files of each kind of prediction."""

KINDS: Final = (*SUFFIXES, "pose")
POSES_FILE: Final = "poses.csv"
_NAME = re.compile(r"([0-9]{1,18})(?:obj([0-9]{1,4}))?", re.ASCII)
_NUMBER = re.compile(r"\s*[0-9]{1,18}\s*", re.ASCII)
_POSE_COLUMNS = ("scene_id", "im_id", "obj_id", "R", "t")

LIMITS: Final = MeshLimits(max_file_mb=64.0, max_vertices=1_000_000, max_faces=2_000_000, max_asset_mb=64.0)
"""Caps on predicted shapes."""

MOST_BYTES: Final = 1 << 28
"""Larger than any array, image or table of poses."""

Key = tuple[str, int, int]
"""(kind, pose id, region); images are of region 0, all regions."""


@dataclass(frozen=True)
class Predictions:
    """What a folder has: by key the names of files, or rows of `poses.csv` as text, of which there should be one.

    `strays`: (kind, why) of what has no id.
    """

    folder: Path
    names: Mapping[Key, tuple[str, ...]]
    strays: tuple[tuple[str, str], ...]
    by_export: bool = False
    """Whether poses.csv is read by the ids of an export."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds that there are."""
        there = {kind for kind, _, _ in self.names} | {kind for kind, _ in self.strays}
        return tuple(kind for kind in KINDS if kind in there)


def find_predictions(folder: Path) -> Predictions:
    """Everything in the folder, by names alone. Raises InputError where there is nothing."""
    names, strays = defaultdict[Key, list[str]](list), list[tuple[str, str]]()
    for kind, suffixes in SUFFIXES.items():
        for path in sorted((folder / kind).iterdir()) if (folder / kind).is_dir() else ():
            name = _NAME.fullmatch(path.stem)
            if path.name.startswith(".") or path.suffix.lower() not in suffixes:
                continue
            if name is None or (name[2] and kind not in ("shape", "volume")):
                strays.append((kind, f"{plain_line(path.name)} is no pose id"))
                continue
            region = REGION_FIRST_OBJECT + int(name[2] or 0) if kind in ("shape", "volume") else 0
            names[kind, int(name[1]), region].append(path.name)
    if os.path.lexists(folder / POSES_FILE):
        try:
            for key, text in _read_poses(folder, strays):
                names[key].append(text)
        except InputError as error:
            strays.append(("pose", str(error)))
    if not names and not strays:
        places = ", ".join(f"{kind}/ID{suffixes[0]}" for kind, suffixes in SUFFIXES.items())
        raise InputError(
            f"{folder} has no predictions: put them into {places} or {POSES_FILE}, named by the mirror pose's id"
        )
    return Predictions(folder, {key: tuple(names[key]) for key in sorted(names)}, tuple(strays))


def by_export_ids(
    given: Predictions, pairs: int, scenes: Iterable[tuple[int, Mapping[int, str]]], role: Role
) -> Predictions:
    """The predictions with poses.csv read by the ids of `verso export --format bop`, if more of its lines name an item so.

    There an image is numbered in its scene, and an instance by its first appearance; `role` is that of the view which poses are
    scored of, lines of other views are left out. scenes: each scene's id, in order, and the instances of its objects by region.
    """
    lines = [(key, text) for key, texts in given.names.items() if key[0] == "pose" for text in texts]
    numbers, items, native = dict[str, int](), dict[tuple[int, int], list[int]](), set[Key]()
    for scene_id, instances in scenes:
        for region, instance in sorted(instances.items()):
            number = numbers.setdefault(instance, len(numbers) + 1)
            items.setdefault((scene_id, number), []).append(region)
            native |= {("pose", 2 * (pairs * scene_id + k) + 1, region) for k in range(pairs)}
    names, strays, meant = defaultdict[Key, list[str]](list), list(given.strays), 0
    for (_, image, number), text in lines:
        word = text.partition("|")[0].strip()
        numbered = int(word) if _NUMBER.fullmatch(word) else -1
        regions = items.get((numbered, number))
        pair, place = divmod(image, len(DRAWN_ROLES))
        if regions is None or pair >= pairs:
            line = f"scene_id {plain_line(word)}, im_id {image}, obj_id {number} of {POSES_FILE}"
            strays.append(("pose", f"{line} is no object of an image"))
            continue
        meant += 1
        if DRAWN_ROLES[place] == role:
            keys = [("pose", 2 * (pairs * numbered + pair) + 1, region) for region in regions]
            names[next((key for key in keys if key not in names), keys[0])].append(text)
    if meant <= sum(key in native for key, _ in lines):
        return given
    others = {key: texts for key, texts in given.names.items() if key[0] != "pose"}
    return Predictions(given.folder, others | {key: tuple(names[key]) for key in sorted(names)}, tuple(strays), True)


def digest_of(folder: Path, key: Key, name: str) -> str:
    """SHA-256 of a prediction, hex: of a file's bytes, or of a line; empty of a file that is refused unread."""
    try:
        data = name.encode() if key[0] == "pose" else read_bytes(folder / key[0] / name, MOST_BYTES)
    except InputError:
        return ""
    return hashlib.sha256(data).hexdigest()


def file_in(folder: Path, name: str) -> Path:
    """The path of a file of the folder. Raises InputError where a link leads out of it: to the truth, or to another's files."""
    path = folder / name
    if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder)):
        raise InputError(f"{plain_line(name)} is a link out of {folder}: put the file itself there")
    return path


def _read_poses(folder: Path, strays: list[tuple[str, str]]) -> Iterator[tuple[Key, str]]:
    path = file_in(folder, POSES_FILE)
    data = read_bytes(path, MOST_BYTES)
    with as_refusal(path, remedy="write it as CSV"):
        reader = csv.DictReader(io.StringIO(data.decode("utf-8-sig")))
        rows, names = list(reader), reader.fieldnames or ()
    if missing := [name for name in _POSE_COLUMNS if name not in names]:
        raise InputError(f"{path} has no column {', '.join(missing)}: it needs {', '.join(_POSE_COLUMNS)}")
    for line, row in enumerate(rows, 2):
        ids = [_NUMBER.fullmatch(row[name] or "") for name in ("im_id", "obj_id")]
        if not all(ids):
            strays.append(("pose", f"line {line} of {POSES_FILE} has no whole im_id and obj_id"))
            continue
        yield ("pose", int(row["im_id"]), int(row["obj_id"])), f"{row['scene_id']}|{row['R']}|{row['t']}"


def read_image(path: Path, shape: tuple[int, ...], depth_units_per_m: float = 0.0) -> NDArray:
    """[H, W] float64 metres of depth, or [H, W, 3] uint8, of this shape. Raises VersoError: another size or type, damage."""
    if path.suffix.lower() == ".npy":
        values = read_array(path, shape)
        if not np.isfinite(values).all():
            count = int((~np.isfinite(values)).sum())
            raise InputError(f"{count} pixels are NaN or infinite: write 0 where nothing is predicted")
        if (values < 0.0).any():
            raise InputError(f"{int((values < 0.0).sum())} pixels are negative: depth is metres along the optical axis")
        return values
    data = read_bytes(path, MOST_BYTES)
    size = int.from_bytes(data[20:24], "big"), int.from_bytes(data[16:20], "big")
    if data[:4] == b"\x89PNG" and len(data) > 24 and size != shape[:2]:  # before it is unpacked
        raise InputError(f"the image is {size[1]} x {size[0]}, the data set's {shape[1]} x {shape[0]}")
    with as_refusal(path.name):
        pixels = decode_png(data, path.name)
    if pixels.shape != shape or pixels.dtype != (np.uint16 if depth_units_per_m else np.uint8):
        wanted = "one channel of 16 bits" if depth_units_per_m else "three channels of 8 bits"
        raise InputError(f"the image is {pixels.shape} {pixels.dtype}, and should have {wanted}")
    return pixels / depth_units_per_m if depth_units_per_m else pixels


def read_array(path: Path, shape: tuple[int, ...]) -> Array:
    """float64 of this shape. Raises InputError; its header is not believed, and no Python object is unpickled."""
    data = read_bytes(path, MOST_BYTES)
    with as_refusal(path.name):
        values = np.load(io.BytesIO(data), allow_pickle=False)
    return _numbers(path, values, shape)


def _numbers(path: Path, values: object, shape: tuple[int, ...] | None) -> Array:
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiub":
        raise InputError(f"{path.name} holds no array of numbers")
    if shape is not None and values.shape != shape:
        raise InputError(f"the array is {values.shape}, and should be {shape}")
    return np.asarray(values, np.float64)


def read_shape(path: Path) -> Mesh | Array:
    """A mesh, or points [N, 3] of a file without faces, in the file's units. Raises VersoError."""
    data, suffix = read_bytes(path, int(LIMITS.max_file_mb * 1e6)), path.suffix.lower()
    from workers.door.meshes.formats import load_shape  # loads what makes data
    from workers.door.meshes.ply import count_ply, parse_ply

    if suffix == ".npz":
        points = _read_points(path, data)
    elif suffix == ".ply" and not count_ply(data)[1]:
        with as_refusal(path.name):
            vertices = parse_ply(data).get("vertex", {})
            if not {*"xyz"} <= vertices.keys():
                raise InputError(f"{path.name} has no vertices with x, y and z")
            points = np.column_stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"])
    else:
        return load_shape(path, LIMITS).shape.mesh
    if points.ndim != 2 or points.shape[1] != 3 or not 3 <= len(points) <= LIMITS.max_vertices:
        raise InputError(f"the cloud is {points.shape}, and should be [N, 3] with 3 to {LIMITS.max_vertices:,} points")
    if not np.isfinite(points).all():
        raise InputError("the cloud has points that are not finite")
    return points


def _read_points(path: Path, data: bytes) -> Array:
    with as_refusal(path.name):
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            unpacked = sum(entry.file_size for entry in file.infolist())
        if unpacked > LIMITS.max_file_mb * 1e6:
            raise InputError(f"{path.name} unpacks to {unpacked / 1e6:.0f} MB, over {LIMITS.max_file_mb:g}")
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            if "points" not in arrays:
                raise InputError(f"{path.name} has {plain_line(', '.join(arrays.files)) or 'nothing'}, and no `points`")
            return _numbers(path, arrays["points"], None)


def read_pose(text: str) -> Pose:
    """[4, 4] object to camera, metres, of R (nine numbers, row-wise) and t (millimetres). Raises InputError."""
    try:
        R, t = (np.array(part.split(), np.float64) for part in text.split("|")[1:])
        T = pose(R.reshape(3, 3), t.reshape(3) / 1e3)
    except ValueError as error:
        raise InputError(f"the pose is not nine numbers R and three numbers t: {plain_line(text)}") from error
    if not is_rigid(T):
        raise InputError(f"R is no rotation: {plain_line(text)}")
    return T
