"""Edge: what readers of meshes share: meshes as files have them; caps on counts, material files and pictures."""

import io
import os
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from schemas.base import Array, Pose
from schemas.errors import MeshError, plain_line
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Material
from workers.door.opening import describe_error

_PICTURES = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "TGA")
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".tga")
_OTHERS = {
    b"\xabKTX": "is a KTX picture, which is not read: convert it to PNG",
    b"DDS ": "is a DDS picture, which is not read: convert it to PNG",
    b"version https://git-lfs": "is a pointer of Git LFS: run `git lfs pull`",
}
"""What other files begin with, and what is said of them."""
_UNDECODABLE = (OSError, ValueError, SyntaxError, Image.DecompressionBombWarning, Image.DecompressionBombError)
"""What reading a stranger's picture may raise."""
LONGEST_NAME = 1024
"""Letters of a file name that are looked at."""
COMMAS = "decimal commas were read as points"
UNPAINTED = "plain base colour used"
"""A note on numbers, and the end of notes on pictures and materials that are left out."""

MOST_NOTES = 20
"""Notes that are kept of an asset: they are stored in the dataset."""
LONGEST_NOTE = 1000
"""Letters of a note, and of a refusal, that are kept."""


Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

MIN_TINT = 0.02
"""Darkest base colour that multiplies a texture; below it the colour is an exporter's leftover and is ignored."""
MIN_ALPHA = 0.01
"""Smallest alpha that is believed; below it alpha is 1, because some exporters write opacity inverted."""
WHITE = Material(base_color=(1.0, 1.0, 1.0, 1.0))
DEFAULT = Material()
"""The material of a mesh that has none; parts with it are recognised by identity."""


@dataclass(frozen=True, eq=False)
class MeshVisual:
    """Material, uv [V, 2] or None, colors [V, 4] uint8 sRGB or None, face_colors [F, 4] uint8 sRGB or None."""

    material: Material
    uv: Array | None = None
    colors: NDArray[np.uint8] | None = None
    face_colors: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class RawMesh:
    """Triangles as a file has them: vertices [V, 3], faces [F, 3] int64, normals [V, 3] or None.

    matrix: the pose [4, 4] of the node that shows them; once placed (`place_mesh`), the identity.
    """

    vertices: NDArray
    faces: Indices
    normals: NDArray | None
    visual: MeshVisual
    matrix: Pose


def make_material(
    color: Array,
    metallic: float,
    roughness: float,
    texture: NDArray[np.uint8] | None,
    notes: list[str],
    left_out: Sequence[str] = (),
) -> Material:
    """A material that can be drawn, from a file's colour [4] (sRGB and alpha) and numbers, which may be anything.

    What was changed is noted, and what is `left_out` of it.
    """
    if color[3] < MIN_ALPHA:
        color[3] = 1.0
        notes.append("an alpha of 0 was read as 1")
    if left_out:
        notes.append(f"not drawn: {', '.join(left_out)}")
    if texture is not None and color[:3].max() < MIN_TINT:
        color[:3] = 1.0
    red, green, blue, alpha = (float(c) for c in np.clip(np.nan_to_num(color, nan=0.7), 0.0, 1.0))
    metallic, roughness = (float(np.clip(np.nan_to_num(value, nan=0.6), 0.0, 1.0)) for value in (metallic, roughness))
    return Material((red, green, blue, alpha), metallic, roughness, texture)


def roughness_of(exponent: float | None) -> float:
    """Perceptual roughness of a Blinn-Phong exponent, None: 1.

    By way of the GGX alpha (Karis, "Specular BRDF reference", 2013).
    """
    known = exponent if exponent is not None and np.isfinite(exponent) else 1.0
    return float((2.0 / (max(known, 0.0) + 2.0)) ** 0.25)


def index_corners(corners: Indices, counts: Sequence[int]) -> tuple[Indices, Indices]:
    """(vertices [V, K], faces [T, 3] into them): one vertex for each combination that corners [T, 3, K] of triangles have.

    counts [K]: how many values each of the K numbers of a corner may name.
    """
    flat = corners.reshape(-1, len(counts))
    key = flat[:, 0]
    for k in range(1, len(counts)):
        key = np.unique(key, return_inverse=True)[1] * counts[k] + flat[:, k]
    _, first, faces = np.unique(key, return_index=True, return_inverse=True)
    return flat[first], faces.reshape(-1, 3)


def cut_polygons(points: Array) -> Indices:
    """[F, n - 2, 3]: which corners of polygons [F, n, 3] their triangles have.

    A fan where a polygon is convex, else ears (mapbox's earcut); a fan also where that finds no way, of one that meets itself.
    """
    count = points.shape[1]
    fan = np.array([[0, k, k + 1] for k in range(1, count - 1)])
    triangles = np.broadcast_to(fan, (len(points), *fan.shape)).copy()
    if count > 3:
        flat, convex = _flatten(points)
        for number in np.flatnonzero(~convex):
            ears = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat[number]), np.array([count], np.uint32))
            if len(ears) == triangles[number].size:
                triangles[number] = ears.reshape(-1, 3)
    return triangles


def cut_faces(path: Path, corners: Indices, counts: Indices, points: Array) -> tuple[Indices, Indices]:
    """(places in `corners` [T, 3], face [T]) of the triangles of faces with `counts` [F] corners, told one after the other.

    corners [C] are numbers of points [N, 3]; MeshError `index_out_of_range` where one of a face is none.
    """
    starts = np.cumsum(counts) - counts
    made, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for size in np.unique(counts[counts > 2]).tolist():
        which = np.flatnonzero(counts == size)
        places = starts[which][:, None] + np.arange(size)
        check_indices(path, corners[places], len(points))
        triangles = cut_polygons(points[corners[places]])
        made.append(places[np.arange(len(which))[:, None, None], triangles].reshape(-1, 3))
        owners.append(np.repeat(which, size - 2))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(made)[order], owner[order]


def _flatten(corners: Array) -> tuple[Array, Mask]:
    """[F, n, 2] polygons [F, n, 3] seen along their normals (Newell's), counter-clockwise; and which are convex."""
    after = np.roll(corners, -1, axis=1)
    centre = corners.mean(axis=1, keepdims=True)
    normal = np.cross(corners - centre, after - centre).sum(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.where(length == 0.0, 1.0, length)
    aside = np.eye(3)[np.abs(normal).argmin(axis=1)]
    x = np.cross(aside, normal)
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300)
    axes = np.stack([x, np.cross(normal, x)], axis=-1)
    flat = (corners - centre) @ axes
    ahead = np.roll(flat, -1, axis=1) - flat
    behind = np.roll(ahead, 1, axis=1)
    turn = behind[..., 0] * ahead[..., 1] - behind[..., 1] * ahead[..., 0]
    slack = 1e-9 * length
    return flat, (turn >= -slack).all(axis=1)


def cut_strip(corners: NDArray[np.int64]) -> Indices:
    """[F, 3]: the triangles of a strip of corners [F + 2]; every second one is turned."""
    faces = np.column_stack([corners[:-2], corners[1:-1], corners[2:]])
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def check_indices(path: Path, faces: Indices, count: int) -> None:
    """MeshError `index_out_of_range` where faces, of any shape, name a vertex beyond the first `count`."""
    if faces.min() < 0 or faces.max() >= count:
        raise MeshError("index_out_of_range", f"{path}: a face names vertex {faces.max()} of {count}")


# ---------------------------------------------------------------------------------------------- caps, files, pictures


def check_counts(path: Path, vertices: int, faces: int, limits: MeshLimits) -> None:
    """MeshError `too_large` where a count is over its cap."""
    for name, count, cap in (("vertices", vertices, limits.max_vertices), ("faces", faces, limits.max_faces)):
        if count > cap:
            raise MeshError("too_large", f"{path} has {count} {name}, over max_{name} = {cap}")


def check_nodes(path: Path, count: int, what: str, limits: MeshLimits) -> None:
    """MeshError `too_large` where an asset has more nodes, or parts, or links than the cap."""
    if count > limits.max_nodes:
        raise MeshError("too_large", f"{path} has {count} {what}, over max_nodes = {limits.max_nodes}")


_FOLDERS = ("textures", "../textures", "../materials/textures")
"""Where pictures lie beside a mesh that names them without their folder."""


def _other_case(path: Path) -> Path:
    """The only file whose name is this one but for upper and lower case; the path itself where there is not one."""
    try:
        names = [entry.name for entry in os.scandir(path.parent) if entry.name.lower() == path.name.lower()]
    except (OSError, ValueError):
        return path
    return path.parent / names[0] if len(names) == 1 else path


def find_inside(root: Path, *candidates: Path) -> Path | None:
    """The first candidate that is a file below `root`, links followed; None where there is none."""
    for candidate in candidates:
        try:
            path = candidate.resolve()
            if path.is_relative_to(root) and path.is_file():
                return path
        except (OSError, ValueError, RuntimeError):
            continue
    return None


@dataclass
class Budget:
    """What one asset has read so far, with all files that it refers to: files, bytes, and pixels of textures."""

    limits: MeshLimits
    files: int = 0
    size: int = 0
    pixels: int = 0

    def take_file(self, size: int) -> str | None:
        """Counts a file; why it may not be read, None where it may."""
        self.files += 1
        self.size += size
        cap = self.limits.max_asset_mb
        return f"is over max_asset_mb = {cap:g} with the files before it" if self.size > cap * 1e6 else None

    def take_image(self, data: bytes) -> str | None:
        """Counts the pixels of a picture; why it may not be decoded, None where it may."""
        size, why = open_image(data, self.limits)
        if why is not None:
            return why
        pixels = size[0] * size[1]
        if self.pixels + pixels > self.limits.max_textures_mpx * 1e6:
            return f"is over max_textures_mpx = {self.limits.max_textures_mpx:g} with the textures before it"
        self.pixels += pixels
        return None


class FolderResolver:
    """Hands a reader the material files and pictures of one folder, and nothing else.

    Names are relative to the mesh, may use either slash, and must stay below `root`. A file that is refused or missing
    leaves a note in `notes`, and the mesh is loaded without it; one that is found elsewhere or in other case a note, too.
    """

    def __init__(self, mesh: Path, root: Path, limits: MeshLimits, budget: Budget | None = None) -> None:
        self.folder = mesh.parent
        self.root = root.resolve()
        self.limits = limits
        self.budget = budget or Budget(limits)
        self.notes: list[str] = []
        self._jpegs: dict[int, tuple[NDArray[np.uint8], bytes]] = {}
        self._pictures: dict[str, NDArray[np.uint8] | None] = {}

    def picture(self, name: str) -> NDArray[np.uint8] | None:
        """The picture of a name, read once; None, and a note, where it is missing, refused or damaged."""
        if name not in self._pictures:
            self._pictures[name] = None
            with suppress(FileNotFoundError):
                plain = name.strip().replace("\\", "/")
                self._pictures[name] = self.decode(plain, self.read(plain))
        return self._pictures[name]

    def decode(self, name: str, data: bytes) -> NDArray[np.uint8] | None:
        """The picture of bytes, as `decode_picture`; None, and a note, where the budget does not allow it."""
        if (why := self.budget.take_image(data)) is not None:
            self.note(name, why)
            return None
        pixels = decode_picture(data, self.notes)
        if pixels is not None and data.startswith(b"\xff\xd8\xff"):
            self._jpegs[id(pixels)] = pixels, data
        return pixels

    def jpeg_of(self, pixels: NDArray[np.uint8] | None) -> bytes | None:
        """The file that a picture was decoded from, if it was a JPEG."""
        return self._jpegs[id(pixels)][1] if id(pixels) in self._jpegs else None

    def read(self, name: str) -> bytes:
        """The bytes of a file of any kind; FileNotFoundError, and a note, where it is missing or refused."""
        if self.budget.files >= self.limits.max_nodes:
            raise self.refuse(name, f"is one of more than max_nodes = {self.limits.max_nodes} files")
        path = self.find(name)
        if path is None:
            self.budget.files += 1
            raise self.refuse(name, "is missing")
        if path.stat().st_size > self.limits.max_file_mb * 1e6:
            raise self.refuse(name, f"is larger than max_file_mb = {self.limits.max_file_mb:g}")
        if (why := self.budget.take_file(path.stat().st_size)) is not None:
            raise self.refuse(name, why)
        if path.name != Path(name).name:
            self.notes.append(plain_line(f"{name} is missing: {path.name} was read in its place", LONGEST_NOTE))
        return path.read_bytes()

    def find(self, name: str) -> Path | None:
        """The file of a name; None where there is none below `root`.

        Looked for relative to the mesh, then beside it, in its folders of pictures (`textures`, and `../materials/textures` as
        Google's scanned objects have them), then in other case.
        """
        name = name.replace("\\", "/")
        if len(name) > LONGEST_NAME:
            return None
        exact, name = self.folder / name, name.strip()
        last = Path(name).name
        places = [exact, self.folder / name, self.folder / last, *(self.folder / folder / last for folder in _FOLDERS)]
        return find_inside(self.root, *places) or find_inside(self.root, *map(_other_case, places[1:3]))

    def picture_beside(self) -> str | None:
        """The name of the first picture in the folder of the mesh; None where there is none."""
        names = sorted(entry.name for entry in os.scandir(self.folder))
        return next((name for name in names if Path(name).suffix.lower() in _SUFFIXES), None)

    def refuse(self, name: str, why: str) -> FileNotFoundError:
        """Notes why a file is not read, and returns the error that says so."""
        self.note(name, why)
        return FileNotFoundError(f"{name:.80} {why}")

    def note(self, name: str, why: str) -> None:
        """Notes that a picture or material is left out."""
        if len(self.notes) < MOST_NOTES:
            self.notes.append(plain_line(f"{name:.{LONGEST_NAME}} {why}: {UNPAINTED}", LONGEST_NOTE))


def open_image(data: bytes, limits: MeshLimits) -> tuple[tuple[int, int], str | None]:
    """Width and height, and why these bytes may not be a texture; None for a picture of a size within the cap."""
    for magic, why in _OTHERS.items():
        if data.startswith(magic):
            return (0, 0), why
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=_PICTURES) as image:
                size = image.size
    except UnidentifiedImageError:
        return (0, 0), f"is no picture that can be read ({', '.join(_PICTURES)})"
    except _UNDECODABLE as error:
        return (0, 0), f"cannot be opened ({describe_error(error)})"
    if max(size) > limits.max_texture_px:
        return size, f"has {max(size)} px, over max_texture_px = {limits.max_texture_px}"
    return size, None


def decode_picture(source: bytes | Image.Image, notes: list[str]) -> NDArray[np.uint8] | None:
    """[h, w, 3 or 4] uint8, read-only, with alpha where it has some; None with a note where it is damaged.

    source: bytes that `Budget.take_image` let pass, or a picture that was opened from such. Grey of 16 bits becomes 8.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = source if isinstance(source, Image.Image) else Image.open(io.BytesIO(source), formats=_PICTURES)
            if image.mode.startswith("I"):  # Pillow would cut what is over 255
                grey = np.round(np.clip(np.asarray(image, np.float64), 0.0, 65535.0) / 257.0)
                pixels = np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
            else:
                alpha = "A" in image.getbands() or "transparency" in image.info
                pixels = np.array(image.convert("RGBA" if alpha else "RGB"), dtype=np.uint8)
    except _UNDECODABLE as error:
        notes.append(f"a texture cannot be decoded ({describe_error(error)}): {UNPAINTED}")
        return None
    pixels.setflags(write=False)
    return pixels
