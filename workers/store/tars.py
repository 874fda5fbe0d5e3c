"""Names of the members of tar archives, and reading of archives. There is one for each range and category.

`mug/RGB00042.png` is the member `00042.RGB.png` of `mug/<start>.tar`, its patch `mug/patches/RGB00042.png` the member
`00042.RGB.patch.png`, and with several objects `00042.RGB.patch.obj1.png`. The pose id comes first, up to a point, so
tools that group members by it (WebDataset among them) see one sample for each pose.
"""

import io
import re
import tarfile
from collections.abc import Iterator
from typing import cast

from schemas.dataset.layout import IMAGES, Content, image_path, patch_path
from schemas.errors import CorruptError

_PATH = re.compile(
    r"(?P<category>[^/]+)/(?P<patch>patches/)?(?P<content>[A-Za-z]+)(?P<pose>\d{5,})(?:obj(?P<object>\d+))?\.png"
)
_MEMBER = re.compile(
    r"(?P<pose>\d{5}|[1-9]\d{5,})\.(?P<content>[A-Za-z]+)(?P<patch>\.patch)?(?:\.obj(?P<object>0|[1-9]\d*))?\.png"
)
_CONTENTS: list[str] = list(dict.fromkeys(image.content for image in IMAGES))


def member_of(path: str) -> tuple[str, str]:
    """(category, member name) of an image. Raises ValueError where the path is not an image's."""
    found = _match(_PATH, path)
    index = "" if found["object"] is None else f".obj{found['object']}"
    return found["category"], f"{found['pose']}.{found['content']}{'.patch' if found['patch'] else ''}{index}.png"


def path_of(category: str, member: str) -> str:
    """The path of the image that a member holds. Raises ValueError where the name is not a member's."""
    found = _match(_MEMBER, member)
    index = None if found["object"] is None else int(found["object"])
    name, pose_id = cast(Content, found["content"]), int(found["pose"])
    return patch_path(category, name, pose_id, index) if found["patch"] else image_path(category, name, pose_id)


def member_order(path: str) -> tuple[int, int, bool, int]:
    """Sorts the images of a scene: by pose, then in the order of the article's figure 1, each before its patches."""
    found = _match(_PATH, path)
    return int(found["pose"]), _CONTENTS.index(found["content"]), bool(found["patch"]), int(found["object"] or 0)


def member_header(name: str, size: int) -> bytes:
    """A tar header that depends on name and size alone: mode 0644, no owner, time 0."""
    header = tarfile.TarInfo(name)
    header.size = size
    return header.tobuf(tarfile.USTAR_FORMAT)


def read_tar(category: str, data: bytes, name: str) -> Iterator[tuple[str, bytes]]:
    """(image path, bytes) of every member, in order. Raises CorruptError naming the archive where it is damaged."""
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            for header in archive:
                file = archive.extractfile(header)
                yield path_of(category, header.name), file.read() if file else b""
    except (tarfile.TarError, ValueError, EOFError) as error:
        raise CorruptError(f"{name} is not a whole archive of images: {error}") from error


def _match(pattern: re.Pattern[str], name: str) -> re.Match[str]:
    found = pattern.fullmatch(name)
    if found is None or found["content"] not in _CONTENTS:
        raise ValueError(f"{name!r} is not the name of an image")
    return found
