"""Names of all files in the output folder, and which views and images a job stores (dataset.md section 1)."""

import re
import urllib.parse
from dataclasses import dataclass
from functools import lru_cache
from operator import attrgetter

from schemas.job.cameras import CAMERA_NAME
from schemas.job.job import Job
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import MODALITIES, ROLES, VIEW_ROLES, Modality, PixelKind, Role, ViewRole

JOB_FILE = "job.yaml"
README_FILE = "DATASET.md"
SUCCESS_FILE = "_SUCCESS"
LOCK_FILE = "_lock.json"
LOG_FOLDER = "_logs"
STAGING = "_staging"
FENCED = ".fenced"
"""Ends the name of an attempt's folder that was taken out of the attempt's reach."""
BEGUN = "_begun"
"""A mark in an attempt's folder, from its beginning until the folder is revoked."""
TEMPORARY = f"{STAGING}/_tmp"
"""Files on their way to their final names; one that a killed process left is swept."""
LOCK_CLAIMS = f"{STAGING}/_lock"
PROBE_PREFIX = ".probe-"
"""Begins names that a killed probe may leave in `TEMPORARY` and beside the commits; they are swept."""
MANIFEST = "manifest"
COMMITS = "manifest/_commits"
RANGES = "manifest/_ranges"
FINGERPRINT_FILE = "manifest/_fingerprint.json"
"""The first worker's stack; a job with `fingerprint: strict` refuses every other."""
LEDGER_FILE = "manifest/_ledger"
"""A summary of the commits that the coordinator keeps, so that not every record is read again; only a cache. Its first line
is the SHA-256 of the rest, which is Parquet."""
ASSETS = "assets"
CAM_POSES = "camPoses.csv"
CAMERAS = "cameras.csv"
OBJECTS = "objects.dat"

MAX_SCENE = 10**15
"""Scene ids are at most this, so that pose ids, a few thousand for a scene, stay below 2**63."""
MAX_RETRIES = 1 << 13
_PLAIN_COMMIT = len("0000000000.json")

ARTICLE = (
    "R. Staszak and D. Belter, *3D object reconstruction: A comprehensive view-dependent dataset*, Data in Brief 55 "
    "(2024) 110569, https://doi.org/10.1016/j.dib.2024.110569, CC BY"
)
"""The article that the layout and the geometry follow, as every page that goes with a dataset cites it."""

Content = str
"""The word in an image's name."""


@dataclass(frozen=True)
class Image:
    """One image of a pair: its content word, the role of its camera, and the kind of its pixels."""

    content: Content
    role: Role
    pixels: PixelKind


IMAGES = tuple(
    Image(word, role.name, modality.name)
    for role in VIEW_ROLES.values()
    for modality in MODALITIES.values()
    if (word := modality.word_of(role)) is not None
)
"""(a)-(k) of the article's figure 1; each also has a patch of every object, (l)-(u)."""


@lru_cache
def images_of(role: Role) -> tuple[Image, ...]:
    """The images that a view of this role may have: of a pair's, or of a camera that a job names."""
    if role in VIEW_ROLES:
        return tuple(image for image in IMAGES if image.role == role)
    named = ViewRole(role, named=True)
    words = ((modality.word_of(named), modality.name) for modality in MODALITIES.values())
    return tuple(Image(word, role, name) for word, name in words if word is not None)


def view_name(role: Role, number: int | None) -> str:
    """How a view is called within its pair: by its role, of a named camera with its number, `around_003`."""
    return role if number is None else f"{role}_{number:03d}"


_UNSAFE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\\]|(?:^|/)\.{0,2}(?:/|\Z)")
"""A letter that no path may have, or a part that is empty, `.` or `..`."""
_CATEGORY = re.compile(r"[^\W_][^\s\x00-,./:-@\[-^`{-\xa9]*")
"""A letter or digit of any script, then anything but blanks and ASCII's signs other than - and _."""
_NAMED = rf"(?:{'|'.join(sorted({modality.word.rstrip('_') for modality in MODALITIES.values()}))})_{CAMERA_NAME}_"
_IMAGE = re.compile(
    rf"{_CATEGORY.pattern}/(?:patches/)?(?:{'|'.join(sorted({image.content for image in IMAGES}))}|{_NAMED})([0-9]{{5,19}})"
    r"(?:_[0-9]{3})?(?:obj[0-9]{1,4})?\.png"
)
_SHAPE = re.compile(rf"{ASSETS}/{_CATEGORY.pattern}/[^/]+\.(?:glb|npz)")
_MERGED = re.compile(rf"{MANIFEST}/[a-z]+/category=[^/]+/part-[0-9]{{5,}}\.parquet")


SWITCHES: dict[Role | PixelKind, str] = {
    **{role.name: role.switch for role in VIEW_ROLES.values() if role.switch is not None},
    **{modality.name: modality.switch for modality in MODALITIES.values() if modality.switch is not None},
}
"""The key of the job that switches a view, or the colour of every view, on and off. What is not here is always stored."""


def is_stored(part: Role | PixelKind, job: Job) -> bool:
    """Whether the job asks for a view, or for a kind of image of every view."""
    if part in MODALITIES and (target := MODALITIES[part].target) is not None:
        return target in job.targets.views and MODALITIES[part].layer <= job.targets.layers
    return part not in SWITCHES or attrgetter(SWITCHES[part])(job)


def stored_roles(job: Job) -> tuple[Role, ...]:
    """The views of each pair that the job asks for, in the order of `ROLES`."""
    return tuple(role for role in ROLES if is_stored(role, job))


def stored_images(role: Role, job: Job) -> tuple[Image, ...]:
    """The images of one view that the job asks for."""
    return tuple(image for image in images_of(role) if is_stored(image.pixels, job))


def stored_shape(modality: Modality, height: int, width: int, job: Job) -> tuple[int, ...]:
    """The shape of the array of a stored image of this size: RGB has alpha where the background is clear."""
    if modality.name == "rgb" and job.has_alpha:
        return height, width, 4
    return modality.shape(height, width)


def patch_index(region_id: int, objects: int) -> int | None:
    """The object's number in a patch's name: k for region 3 + k, None in a scene with one object."""
    return None if objects == 1 else region_id - REGION_FIRST_OBJECT


def input_pose_id(scene_id: int, pair: int, pairs_per_scene: int) -> int:
    """The even id of pair `pair` of a scene; its mirror pose has the next, odd, id."""
    return 2 * (scene_id * pairs_per_scene + pair)


def file_pose_id(role: Role, parent_id: int) -> int:
    """The id in a file's name: the mirror pose's for the mirror view, else the input pose's."""
    return parent_id + 1 if role == "mirror" else parent_id


def image_path(
    category: str, content: Content, pose_id: int, object_index: int | None = None, number: int | None = None
) -> str:
    """`mug/RGB00000.png`; of an object's own image, with several objects, `mug/amodal00000obj1.png`.

    Of view 3 of a named camera `mug/RGB_around_00000_003.png`.
    """
    suffix = ("" if number is None else f"_{number:03d}") + ("" if object_index is None else f"obj{object_index}")
    return f"{category}/{content}{pose_id:05d}{suffix}.png"


def patch_path(category: str, content: Content, pose_id: int, object_index: int | None = None) -> str:
    """`mug/patches/RGB00000.png`, with several objects `mug/patches/RGB00000obj1.png`."""
    folder, name = image_path(category, content, pose_id, object_index).split("/")
    return f"{folder}/patches/{name}"


def asset_path(category: str, instance_id: str) -> str:
    """`assets/mug/<instance>.glb`."""
    return f"{ASSETS}/{category}/{instance_id}.glb"


def samples_path(category: str, instance_id: str) -> str:
    """`assets/mug/<instance>.npz`: points of the shape's surface and volume (`targets.shape`)."""
    return f"{ASSETS}/{category}/{instance_id}.npz"


def is_shape(path: str) -> bool:
    """True for a file that several ranges may make, with the same bytes."""
    return path.startswith(f"{ASSETS}/")


def is_glb(path: str) -> bool:
    """True for the GLB of a shape, which no column of a merged table lists."""
    return is_shape(path) and path.endswith(".glb")


def is_plain_path(path: str) -> bool:
    """Whether a path stays below the folder that it is joined to, and prints as one line.

    Parts are neither empty nor `.` nor `..`, and hold no backslash and no control character.
    """
    return not _UNSAFE.search(path)


def is_attempt_name(name: str, retry: int) -> bool:
    """Whether an attempt of this retry may have the name, which is one part of a path."""
    return re.fullmatch(rf"r{retry}-[A-Za-z0-9_.-]{{1,200}}", name) is not None and not name.endswith(FENCED)


def pose_of_image(path: str) -> int | None:
    """The number in an image's or a patch's name, None where the path is none of one."""
    match = _IMAGE.fullmatch(path)
    return int(match[1]) if match and path.partition("/")[0] not in (MANIFEST, ASSETS) else None


def is_range_file(path: str, start: int, retry: int) -> bool:
    """Whether the path is one of this commit's tables or tars, or a shape's."""
    if is_shape(path):
        return _SHAPE.fullmatch(path) is not None and is_plain_path(path)
    if path.startswith(f"{MANIFEST}/"):
        return path == range_table_path(start, path.rpartition("/")[2].partition(".")[0], retry)
    category = path.partition("/")[0]
    return _CATEGORY.fullmatch(category) is not None and path == tar_path(category, start, retry)


def is_merged_path(path: str) -> bool:
    """Whether the merge writes a file of this name."""
    return path in (CAM_POSES, CAMERAS, OBJECTS) or (_MERGED.fullmatch(path) is not None and is_plain_path(path))


def range_name(start: int, retry: int = 0) -> str:
    """`0000000016`, for a retry `0000000016.retry-2`. Ten digits, so that names sort like numbers."""
    return f"{start:010d}{f'.retry-{retry}' if retry else ''}"


def parse_range_name(name: str) -> int | None:
    """The start that a folder of `_staging/` is named after, None where it is no such name."""
    return int(name) if re.fullmatch("[0-9]{10,19}", name) and range_name(int(name)) == name else None


def commit_path(start: int, retry: int = 0) -> str:
    """The record that a range is done; `retry` numbers the later tries of its environmental failures."""
    return f"{COMMITS}/{range_name(start, retry)}.json"


def parse_commit_name(name: str) -> tuple[int, int] | None:
    """(start, retry) of the name of a commit record's file, None where it is no such name."""
    if len(name) == _PLAIN_COMMIT and name.endswith(".json") and name[:10].isdecimal() and name.isascii():
        return int(name[:10]), 0  # nearly all of them, a million times
    match = re.fullmatch(r"([0-9]{10,16})(?:\.retry-([0-9]{1,4}))?\.json", name)
    numbers = match and (int(match[1]), int(match[2] or 0))
    inside = numbers and numbers[0] <= MAX_SCENE and numbers[1] < MAX_RETRIES
    return numbers if numbers and inside and commit_path(*numbers) == f"{COMMITS}/{name}" else None


def range_table_path(start: int, table: str, retry: int = 0) -> str:
    """Rows of one range, one file a table."""
    return f"{RANGES}/{range_name(start, retry)}/{table}.parquet"


def tar_path(category: str, start: int, retry: int = 0) -> str:
    """`mug/0000000016.tar`: the images of one category that one commit holds."""
    return f"{category}/{range_name(start, retry)}.tar"


def merged_table_path(table: str, category: str, number: int) -> str:
    """`manifest/views/category=mug/part-00000.parquet`: a hive partition that pyarrow finds."""
    return f"{MANIFEST}/{table}/category={urllib.parse.quote(category, safe='')}/part-{number:05d}.parquet"


def staging_path(start: int, attempt: str) -> str:
    """The only place that an attempt writes."""
    return f"{STAGING}/{range_name(start)}/{attempt}"


def scratch_path(name: str) -> str:
    """Where a step of this name keeps files while it works."""
    return f"{STAGING}/_{name}"
