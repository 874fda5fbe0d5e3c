"""Edge: what a mesh from outside may hold and refer to: caps on counts, material files, pictures."""

import io
import os
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from schemas.errors import MeshError, plain_line
from schemas.job.assets import MeshLimits
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
MOST_NOTES = 20
"""Notes that are kept of an asset: they are stored in the dataset."""
LONGEST_NOTE = 1000
"""Letters of a note, and of a refusal, that are kept."""


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
        found = [entry.name for entry in os.scandir(path.parent) if entry.name.lower() == path.name.lower()]
    except (OSError, ValueError):
        return path
    return path.parent / found[0] if len(found) == 1 else path


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
            self.notes.append(plain_line(f"{name:.{LONGEST_NAME}} {why}: plain base colour used", LONGEST_NOTE))


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
        notes.append(f"a texture cannot be decoded ({describe_error(error)}): plain base colour used")
        return None
    pixels.setflags(write=False)
    return pixels
