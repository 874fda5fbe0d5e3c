"""Edge: the material files and textures that a mesh from outside may use."""

import io
import re
import warnings
from pathlib import Path

from PIL import Image
from trimesh.resolvers import Resolver

from schemas.job.assets import MeshLimits

_PICTURES = {b"\x89PNG\r\n\x1a\n": "PNG", b"\xff\xd8\xff": "JPEG"}
_ADDRESS = re.compile(r"\s*<[^<>]* at 0x[0-9a-fA-F]+>")


class FolderResolver(Resolver):
    """Hands trimesh the material files and PNG or JPEG textures of one folder, and nothing else.

    Names are relative to the mesh, may use either slash, and must stay below `root`. What is refused or missing is
    told in `notes`, and the mesh goes without it.
    """

    def __init__(self, mesh: Path, root: Path, limits: MeshLimits) -> None:
        self.folder = mesh.parent
        self.root = root.resolve()
        self.limits = limits
        self.notes: list[str] = []

    def get(self, key: str) -> bytes:
        """The bytes of a file; raises FileNotFoundError where it is missing or refused."""
        name = str(key).strip().replace("\\", "/")
        path = self.find(name)
        if path is None:
            raise self._refuse(name, "is missing")
        if path.stat().st_size > self.limits.max_file_mb * 1e6:
            raise self._refuse(name, f"is larger than max_file_mb = {self.limits.max_file_mb:g}")
        data = path.read_bytes()
        if path.suffix.lower() != ".mtl" and (why := image_fault(data, self.limits)) is not None:
            raise self._refuse(name, why)
        return data

    def find(self, name: str) -> Path | None:
        """The file that a name means, if it lies below `root`: relative to the mesh, or beside it."""
        name = name.strip().replace("\\", "/")
        for candidate in (self.folder / name, self.folder / Path(name).name):
            try:
                path = candidate.resolve()
                inside = path.is_relative_to(self.root)
            except (OSError, ValueError, RuntimeError):
                continue
            if inside and path.is_file():
                return path
        return None

    def _refuse(self, name: str, why: str) -> FileNotFoundError:
        self.notes.append(f"{name} {why}: plain base colour used")
        return FileNotFoundError(name)

    def write(self, name: str, data: object) -> None:
        """Refused: reading never writes."""
        raise PermissionError(name)

    def namespaced(self, namespace: str) -> "FolderResolver":
        """This resolver itself."""
        return self

    def keys(self) -> list[str]:
        """Nothing is listed."""
        return []


def describe_error(error: Exception) -> str:
    """Kind and message of an error without addresses in memory: what is said of a mesh goes into the dataset."""
    return _ADDRESS.sub("", repr(error))


def image_fault(data: bytes, limits: MeshLimits) -> str | None:
    """Why these bytes may not be a texture, or None: a PNG or JPEG by its first bytes, of a size within the cap."""
    kind = next((kind for magic, kind in _PICTURES.items() if data.startswith(magic)), None)
    if kind is None:
        return "is not a PNG or JPEG file"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=(kind,)) as image:
                largest = max(image.size)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        return f"cannot be opened ({describe_error(error)})"
    return (
        f"has {largest} px, over max_texture_px = {limits.max_texture_px}" if largest > limits.max_texture_px else None
    )
