"""Cameras and views of a scene: raw buffers, stored views with their labels, pairs of views."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Frozen, Pose
from schemas.job.cameras import Sensor
from schemas.job.views import MOST_LAYERS, Patch, ViewTarget

Role = str
"""The name of a view's place in its pair."""


@dataclass(frozen=True)
class ViewRole:
    """What a view of a pair is; its switch, its effect and the names of its files follow."""

    name: Role
    branch: str | None = None
    """The branch of the job whose `enabled` switches it on and off; None where it is always stored."""
    effect: str | None = None
    """The effect that it is made by, where it can be left out."""
    beside: bool = False
    """Drawn by a camera that stands beside the input camera, at its branch's `offset_m`; it shares the input's pose id."""
    named: bool = False
    """Drawn by a camera of `cameras.more`, and not of a pair: its name is the entry's."""
    projected: bool = False
    """Carried over from the input view into the mirror camera, not drawn: it has no regions and no labels."""

    @property
    def switch(self) -> str | None:
        """The key of the job that switches it on and off."""
        return None if self.branch is None else f"{self.branch}.enabled"


VIEW_ROLES: dict[Role, ViewRole] = {
    role.name: role
    for role in (
        ViewRole("input"),
        ViewRole("aligned", "cameras.depth", "depth_camera", beside=True),
        ViewRole("mirror", "cameras.mirror", "mirror"),
        ViewRole("projected", "images.projection", "projection", projected=True),
    )
}
"""Every view that a pair may have, in the order that tables and files have them in."""

ROLES: tuple[Role, ...] = tuple(VIEW_ROLES)
DRAWN_ROLES: tuple[Role, ...] = tuple(role.name for role in VIEW_ROLES.values() if not role.projected)

PixelKind = str
"""The name of a modality."""

FULL = 65_535
"""The code of 1 in an image of 16 bits."""

LAYERS = range(1, MOST_LAYERS + 1)
"""Numbers of the surfaces along a pixel's ray, from the front."""


@dataclass(frozen=True)
class Modality:
    """A kind of image that views have, stored as PNG without loss."""

    name: PixelKind
    word: str
    """The word in the names of its files."""
    dtype: str
    channels: int = 1
    switch: str | None = None
    """The key of the job that switches it on and off in every view; None where it is always stored."""
    of_input: bool = True
    """Whether the input view has such an image too."""
    projected: bool = False
    """Whether a view that is projected and not drawn has such an image too."""
    target: ViewTarget | None = None
    """The item of the job's `targets.views` that it belongs to."""
    layer: int = 0
    """It is stored where the job's `targets.layers` is at least this."""
    each: bool = False
    """One image for each object, in the order of their regions; as an array [objects, H, W]."""
    formula: str | None = None
    """The formula of `services/read/independent/targets.py` for what a pixel shows; None where it has none of its own there."""

    def word_of(self, role: ViewRole) -> str | None:
        """The word in the file's name (`RGB`, `RGBaligned`, `depthAligned`); None where such a view has no such image."""
        if (role.projected and not self.projected) or (role.name == "input" and not self.of_input):
            return None
        if role.named:
            return f"{self.word.rstrip('_')}_{role.name}_"
        suffix = role.name if role.beside or role.projected else ""
        return self.word + (suffix if self.word.isupper() else suffix.capitalize())

    def shape(self, height: int, width: int) -> tuple[int, ...]:
        """Of the array of an image of this size."""
        return (height, width) if self.channels == 1 else (height, width, self.channels)


MODALITIES: dict[PixelKind, Modality] = {
    modality.name: modality
    for modality in (
        Modality("rgb", "RGB", "uint8", 3, "render.rgb", projected=True),
        Modality("depth", "depth", "uint16", projected=True),
        Modality("region", "segment", "uint8"),
        Modality("normals", "normals", "uint16", 3, target="normals", formula="normals"),
        Modality("coordinates", "coordinates", "uint16", 3, target="coordinates", formula="coordinates"),
        Modality("albedo", "albedo", "uint8", 3, target="albedo", formula="albedo"),
        Modality("covisible", "covisible", "uint8", of_input=False, target="covisible"),
        Modality("amodal", "amodal", "uint8", target="amodal", each=True),
        *(Modality(f"layer{n}", f"layer{n}_", "uint16", target="layers", layer=n) for n in LAYERS),
        *(Modality(f"layer{n}_region", f"layerSegment{n}_", "uint8", target="layers", layer=n) for n in LAYERS),
        Modality("back", "back", "uint16", target="layers"),
        Modality("back_region", "backSegment", "uint8", target="layers"),
    )
}
"""Every modality there is. Files, `verify`, the Python door and the exports take from here which images there are."""


class Intrinsics(Frozen):
    """A pinhole camera whose pixel (column i, row j) has its centre at (i + 0.5, j + 0.5).

    `cx_opencv`, `cy_opencv` are the same principal point where pixel centres lie on integers.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def cx_opencv(self) -> float:
        """Principal point, pixels, with the first pixel's centre at 0."""
        return self.cx - 0.5

    @property
    def cy_opencv(self) -> float:
        """Principal point, pixels, with the first pixel's centre at 0."""
        return self.cy - 0.5

    @staticmethod
    def of(sensor: Sensor) -> "Intrinsics":
        """The intrinsics that a job's sensor describes; of its ranges the middle."""
        return Intrinsics(**sensor.fixed().model_dump())


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics and `T_world_cam` [4, 4] float64, optical frame."""

    intrinsics: Intrinsics
    T_world_cam: Pose

    @property
    def position(self) -> Array:
        """[3] float64, world, metres."""
        return self.T_world_cam[:3, 3]


@dataclass(frozen=True, eq=False)
class NamedCamera:
    """One camera of an entry of the job's `cameras.more`, by the entry's name and its number in it, from 0."""

    name: str
    number: int
    camera: Camera


@dataclass(frozen=True, eq=False)
class GBuffer:
    """One camera's colour, depth and region at the centre of every pixel.

    rgb [H, W, 3] uint8 sRGB, None where no colour was drawn; depth_m [H, W] float32, z along the optical axis, 0 where
    nothing was hit (not yet clipped to the stored range); region [H, W] uint8.
    """

    rgb: NDArray[np.uint8] | None
    depth_m: NDArray[np.float32]
    region: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class ObjectLabel:
    """One region in one view.

    `T_cam_obj` [4, 4]; the pixel (u, v) of the object's origin or (-1, -1); the bounding box and count of its pixels;
    `visible_fraction` of its own unoccluded pixels, which count also outside the frame.
    """

    region_id: int
    category: str
    instance_id: str
    T_cam_obj: Pose
    u: int
    v: int
    bbox_xywh: tuple[int, int, int, int]
    pixels: int
    visible_fraction: float


@dataclass(frozen=True, eq=False)
class View:
    """One camera's images as they are stored, and its labels (none for a projected view).

    rgb [H, W, 3] uint8 (with alpha [H, W, 4]), or None where the job asks for no colour; depth [H, W] uint16 in units of
    `Images.depth_units_per_m`; region [H, W] uint8, or None where the images were projected and not rendered. `pose_id` is
    the view's own; `parent_id` the input pose's.
    """

    role: Role
    pose_id: int
    parent_id: int
    camera: Camera
    rgb: NDArray[np.uint8] | None
    depth: NDArray[np.uint16]
    region: NDArray[np.uint8] | None
    labels: tuple[ObjectLabel, ...]
    further: Mapping[PixelKind, NDArray] = field(default_factory=dict)
    """Images of the other modalities."""
    number: int | None = None
    """Its number among the views of its role, of a camera of `cameras.more`."""

    @property
    def images(self) -> Mapping[PixelKind, NDArray]:
        """Every image that the view has, by modality."""
        known = {"rgb": self.rgb, "depth": self.depth, "region": self.region, **self.further}
        return {name: pixels for name, pixels in known.items() if pixels is not None}


@dataclass(frozen=True, eq=False)
class Agreement:
    """Input depth carried into the mirror view against mirror depth, where both cameras see the surface.

    Of the object: median_mm, share within the bound, points compared; median and share are None below 50 points.
    `scene_median_mm` is over every region.
    """

    median_mm: float | None
    share: float | None
    points: int
    scene_median_mm: float | None


@dataclass(frozen=True, eq=False)
class Pair:
    """An input pose and its mirror pose with all their views; None where the job switches a view off.

    filled_share: share of the mirror image's pixels that the projection fills; hidden_share: share of the filled ones that
    show a surface behind what the mirror camera sees. `agreement` is of the stored images, `exact_agreement` of the images
    before the sensors' effects.
    """

    d_z_m: float
    input: View
    beside: tuple[View, ...] = ()
    """Those of cameras beside the input camera."""
    mirror: View | None = None
    projected: View | None = None
    agreement: Agreement | None = None
    exact_agreement: Agreement | None = None
    filled_share: float | None = None
    hidden_share: float | None = None

    @property
    def views(self) -> tuple[View, ...]:
        """The views that exist, in the order of `ROLES`."""
        there = {
            view.role: view for view in (self.input, *self.beside, self.mirror, self.projected) if view is not None
        }
        return tuple(there[role] for role in ROLES if role in there)


def crop_box(label: ObjectLabel, camera: Camera, patch: Patch) -> tuple[slice, slice] | None:
    """(rows, columns) of the crop centred on the object's image coordinates.

    None where it would leave the image, and where the view does not see the object.
    """
    if label.u < 0 or label.pixels == 0:
        return None
    left, top = label.u - patch.width // 2, label.v - patch.height // 2
    right, bottom = left + patch.width, top + patch.height
    if left < 0 or top < 0 or right > camera.intrinsics.width or bottom > camera.intrinsics.height:
        return None
    return slice(top, bottom), slice(left, right)
