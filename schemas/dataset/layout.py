"""Every name and key in the output folder, in one place (dataset.md section 1, contract.md "Output folder")."""

from dataclasses import dataclass
from typing import Literal

from schemas.job.job import Job
from schemas.scene.camera import ROLES, Role
from schemas.scene.region import REGION_FIRST_OBJECT

JOB_FILE = "job.yaml"
README_FILE = "DATASET.md"
SUCCESS_FILE = "_SUCCESS"
LOCK_FILE = "_lock.json"
LOG_FOLDER = "_logs"
STAGING = "_staging"
MANIFEST = "manifest"
COMMITS = "manifest/_commits"
RANGES = "manifest/_ranges"
FINGERPRINT_FILE = "manifest/_fingerprint.json"
"""The stack that the first worker had; a job with `fingerprint: strict` refuses every other."""
ASSETS = "assets"
CAM_POSES = "camPoses.csv"
CAMERAS = "cameras.csv"
OBJECTS = "objects.dat"
MERGED_FILES = (CAM_POSES, CAMERAS, OBJECTS)

Content = Literal[
    "RGB", "depth", "segment", "RGBaligned", "depthAligned", "segmentAligned", "RGBprojected", "depthProjected"
]

PixelKind = Literal["rgb", "depth", "region"]
"""Which of a view's arrays an image shows."""


@dataclass(frozen=True)
class Image:
    """One of the images of a pair: its content word, which camera sees it, and what its pixels are."""

    content: Content
    role: Role
    pixels: PixelKind


IMAGES: tuple[Image, ...] = (
    Image("RGB", "input", "rgb"),
    Image("depth", "input", "depth"),
    Image("segment", "input", "region"),
    Image("RGBaligned", "aligned", "rgb"),
    Image("depthAligned", "aligned", "depth"),
    Image("segmentAligned", "aligned", "region"),
    Image("RGB", "mirror", "rgb"),
    Image("depth", "mirror", "depth"),
    Image("segment", "mirror", "region"),
    Image("RGBprojected", "projected", "rgb"),
    Image("depthProjected", "projected", "depth"),
)
"""(a)-(k) of the article's figure 1; each also has a patch of every object, (l)-(u)."""


def stored_roles(job: Job) -> tuple[Role, ...]:
    """The views of each pair that the job asks for, in the order of `ROLES`."""
    off = {
        "aligned": not job.cameras.depth.enabled,
        "mirror": not job.cameras.mirror.enabled,
        "projected": not job.images.projection.enabled,
    }
    return tuple(role for role in ROLES if not off.get(role, False))


def stored_images(role: Role, job: Job) -> tuple[Image, ...]:
    """The images of one view that the job asks for."""
    return tuple(image for image in IMAGES if image.role == role and (image.pixels != "rgb" or job.render.rgb))


def patch_index(region_id: int, objects: int) -> int | None:
    """Which object a patch's name tells: k for region 3 + k, None in a scene that has one object only."""
    return None if objects == 1 else region_id - REGION_FIRST_OBJECT


def input_pose_id(scene_id: int, pair: int, pairs_per_scene: int) -> int:
    """The even id of pair `pair` of a scene; its mirror pose has the next, odd, id."""
    return 2 * (scene_id * pairs_per_scene + pair)


def file_pose_id(role: Role, parent_id: int) -> int:
    """The id in a file's name: the input pose's, but the mirror's own for what the mirror camera renders."""
    return parent_id + 1 if role == "mirror" else parent_id


def image_path(category: str, content: Content, pose_id: int) -> str:
    """`mug/RGB00000.png`."""
    return f"{category}/{content}{pose_id:05d}.png"


def patch_path(category: str, content: Content, pose_id: int, object_index: int | None = None) -> str:
    """`mug/patches/RGB00000.png`, with several objects `mug/patches/RGB00000obj1.png`."""
    suffix = "" if object_index is None else f"obj{object_index}"
    return f"{category}/patches/{content}{pose_id:05d}{suffix}.png"


def asset_path(category: str, instance_id: str) -> str:
    """`assets/mug/<instance>.glb`."""
    return f"{ASSETS}/{category}/{instance_id}.glb"


def range_key(start: int) -> str:
    """Ten digits, so that names sort like numbers."""
    return f"{start:010d}"


def commit_path(start: int, retry: int = 0) -> str:
    """The record that a range is done; `retry` numbers the later tries of its environmental failures."""
    return f"{COMMITS}/{range_key(start)}{f'.retry-{retry}' if retry else ''}.json"


def range_table_path(start: int, table: str, retry: int = 0) -> str:
    """Rows of one range, one file a table."""
    return f"{RANGES}/{range_key(start)}{f'.retry-{retry}' if retry else ''}/{table}.parquet"


def staging_path(start: int, attempt: str) -> str:
    """The only place that an attempt writes."""
    return f"{STAGING}/{range_key(start)}/{attempt}"
