"""The cameras of a job: where input cameras stand, their sensor, the cameras beside and opposite, and those that a job names."""

import math
import re
from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field, Tag, field_validator, model_validator

from schemas.base import Folder, Frozen, Interval, Range, among_kinds, ordered

FocalLength = Annotated[float, Field(ge=1e-3, le=1e6)]
PrincipalPoint = Annotated[float, Field(ge=-1e6, le=1e6)]
Reach = Annotated[float, Field(gt=0, le=1e3)]
Offset = Annotated[float, Field(ge=-1e3, le=1e3)]
"""Bounds far beyond any camera, within which float32 on the GPU does not overflow."""


FIT_SHARE = 0.06
"""What `fit` stands for: a round thing then is a quarter of the picture wide."""


def _read_share(text: str) -> str:
    if text != "fit" and not (re.fullmatch(r"\d+(\.\d+)? ?%", text) and 0.0 < float(text.rstrip("% ")) <= 50.0):
        raise ValueError("write metres, fit, or a share of the picture, such as 6%, up to 50%")
    return text


_ORDERED = AfterValidator(lambda ends: ordered(Range(*ends)))
Framed = Annotated[
    Annotated[Reach, Tag("[number]")]
    | Annotated[tuple[Reach, Reach], _ORDERED, Tag("[list]")]
    | Annotated[str, AfterValidator(_read_share), Tag("[word]")],
    among_kinds("[number]", "[list]", "[word]"),
]
"""A distance: metres, [least, most] to draw from, `fit`, or a share of the picture."""
Behind = Annotated[
    Annotated[Reach, Tag("[number]")]
    | Annotated[tuple[Reach, Reach], _ORDERED, Tag("[list]")]
    | Annotated[Literal["fit"], Tag("[word]")],
    among_kinds("[number]", "[list]", "[word]"),
]
Focal = Annotated[
    Annotated[FocalLength, Tag("[number]")] | Annotated[tuple[FocalLength, FocalLength], _ORDERED, Tag("[list]")],
    among_kinds("[number]", "[list]"),
]
Principal = Annotated[
    Annotated[PrincipalPoint, Tag("[number]")]
    | Annotated[tuple[PrincipalPoint, PrincipalPoint], _ORDERED, Tag("[list]")],
    among_kinds("[number]", "[list]"),
]
"""A number, or [least, most] to draw from for each input camera."""


def at_share(value: float | tuple[float, float], share: float) -> float:
    """The number, or of a range this share of the way from its least to its most."""
    return value[0] + share * (value[1] - value[0]) if isinstance(value, tuple) else value


def share_of(radius_m: object, fit: float) -> float | None:
    """The share of the picture that a distance stands for, `fit` where it says so; None where it is given in metres."""
    if not isinstance(radius_m, str):
        return None
    return fit if radius_m == "fit" else float(radius_m.rstrip("% ")) / 100.0


def _as_interval(value: object) -> object:
    """One number as both ends of an interval."""
    return [value, value] if isinstance(value, int | float) and not isinstance(value, bool) else value


OneOrRange = Annotated[Interval, BeforeValidator(_as_interval)]
"""[least, most] to draw from, or one number."""


class Orbit(Frozen):
    """Where input cameras stand: spherical coordinates about the centre of the table top [A], or of the objects at rest."""

    inclination_rad: Interval = Range(0.7, 0.9)
    """Angle of the optical axis below the horizontal."""
    yaw_rad: Interval = Range(-math.pi, math.pi)
    """Direction from the table to the camera."""
    radius_m: Framed = 2.5
    """Distance from the centre of the table top, or [least, most]. `6%`, or `fit` for the same: as near to the middle of the
    objects at rest as they cover that share of the picture, none is cut off, and all are in the range of depth."""

    aim_m: OneOrRange = Range(0.0, 0.0)
    """Offset of the point looked at along x, y and z, each drawn."""
    roll_deg: OneOrRange = Range(0.0, 0.0)
    """Turn of the camera about its optical axis."""
    always: bool = False
    """Whether input cameras stand on the orbit also where `scenes_from` has cameras."""

    @property
    def share(self) -> float | None:
        """The share of the picture that objects are to cover; None where the distance is given."""
        return share_of(self.radius_m, FIT_SHARE)


class Sensor(Frozen):
    """A pinhole camera. cx, cy count from the image's left and upper edge: pixel centres lie at +0.5 [A, D]."""

    width: Annotated[int, Field(ge=1, le=4096)] = 640
    """Pixels."""
    height: Annotated[int, Field(ge=1, le=4096)] = 480
    """Pixels."""
    fx: Focal = 525.0
    """Focal length, pixels; or [least, most], of which fx and fy of one camera are the same share of the way."""
    fy: Focal = 525.0
    """Focal length, pixels, or a range as of fx."""
    cx: Principal = 320.0
    """Principal point, pixels from the left edge, or [least, most]."""
    cy: Principal = 240.0
    """Principal point, pixels from the upper edge, or [least, most]."""

    def fixed(self, share: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> "Sensor":
        """The sensor with one number in the place of each range: this share of the way, of focal lengths, of cx, of cy."""
        shares = dict(zip(("fx", "fy", "cx", "cy"), (share[0], *share), strict=True))
        return self.model_copy(update={name: at_share(getattr(self, name), part) for name, part in shares.items()})

    @property
    def has_ranges(self) -> bool:
        """Whether a camera's own numbers are drawn."""
        return any(isinstance(getattr(self, name), tuple) for name in ("fx", "fy", "cx", "cy"))


class DepthCamera(Frozen):
    """The depth camera's place in the RGB camera's optical axes, metres; same rotation [A]."""

    enabled: bool = True
    """Whether there are aligned views."""
    offset_m: tuple[Offset, Offset, Offset] = (-0.051, 0.001, -0.001)
    """Translation in the RGB camera's optical axes."""


MIRROR_FIT = 1.5
"""T_z by d_z where it is `fit`: what is beyond the pivot lies lower in the mirror view, and tall things are still seen whole."""


class Mirror(Frozen):
    """The camera on the other side [A, C]."""

    enabled: bool = True
    """Whether there are mirror views; without them camPoses.csv has the even ids alone."""
    T_z_m: Behind = 1.3
    """Distance of the mirror camera from its pivot, the point it looks at, or [least, most]. `fit`: 1.5 d_z."""
    percentile: Annotated[float, Field(ge=0, le=100)] = 2.0
    """d_z, the distance to the object's front, is this percentile of its stored input depth; 0: the nearest."""

    def distance_m(self, d_z_m: float, share: float = 0.5) -> float:
        """T_z, metres, for a pivot d_z_m ahead of the input camera; of a range this share of the way."""
        return MIRROR_FIT * d_z_m if isinstance(self.T_z_m, str) else at_share(self.T_z_m, share)


MOST_VIEWS = 1000
"""Of one entry of `cameras.more`, in a scene."""

SPHERE_SHARE = 0.5
"""What `fit` stands for in `cameras.more`: the objects' bounding sphere is drawn 0.8 of a square picture wide."""

Count = Annotated[int, Field(ge=1, le=MOST_VIEWS)]
Inclination = Annotated[Interval, AfterValidator(lambda ends: _within(ends, math.pi / 2, "an inclination", "pi/2"))]


def _within(ends: Range, most: float, what: str, named: str) -> Range:
    if max(abs(end) for end in ends) > most + 1e-9:
        raise ValueError(f"[{ends.low:g}, {ends.high:g}]: {what} lies between -{named} and {named}")
    return ends


class Ring(Frozen):
    """Cameras at equal steps of direction, counter-clockwise from above, that look at one point."""

    count: Count = 8
    """Number of cameras."""
    inclination_rad: Annotated[Inclination, BeforeValidator(_as_interval)] = Range(0.5, 0.5)
    """Angle of the optical axis below the horizontal; of an interval each camera has its own."""
    start_rad: OneOrRange = Range(0.0, 0.0)
    """Direction of the first camera from the point, from the x axis of the world or from the input camera's."""
    start: Literal["world", "input"] = "world"
    """What `start_rad` counts from."""
    radius_m: Framed = "fit"
    """Distance; `fit`: the bounding sphere of the objects covers half of the picture, `30%`: that share of it."""


class Sphere(Frozen):
    """Cameras spread over a sphere, or a band of it, that look at its middle."""

    count: Count = 24
    """Number of cameras."""
    pattern: Literal["hammersley", "fibonacci", "uniform", "cube", "trellis"] = "hammersley"
    """hammersley, fibonacci: spread evenly, turned at random in each scene; uniform: each at random; cube: the same, denser
    towards the corners of a cube, as Zero123 has it; trellis: a Hammersley set with three quarters of its views above."""
    inclination_rad: Annotated[Inclination, BeforeValidator(_as_interval)] = Range(-math.pi / 2, math.pi / 2)
    """Angle of the optical axis below the horizontal: the band of the sphere."""
    height_m: OneOrRange | None = None
    """Heights above the point looked at: a camera of pattern uniform or cube is drawn again until its own lies between."""
    radius_m: Framed = "fit"
    """Distance, as in `ring`; of an interval each camera has its own."""

    @model_validator(mode="after")
    def _reaches_heights(self) -> "Sphere":
        if self.height_m is None:
            return self
        if self.pattern not in ("uniform", "cube"):
            raise ValueError(
                f"height_m is for the patterns uniform and cube, and pattern is {self.pattern}: leave it out"
            )
        if isinstance(self.radius_m, str):
            raise ValueError(f"height_m needs a radius_m in metres, and it is {self.radius_m}")
        most = self.radius_m[1] if isinstance(self.radius_m, tuple) else self.radius_m
        if self.height_m.low >= most or self.height_m.high <= -most:
            raise ValueError(f"height_m {list(self.height_m)} is nowhere on a sphere of radius_m {most:g}")
        return self


ROLES_OF_A_PAIR = ("input", "aligned", "mirror", "projected")
CAMERA_NAME = "[A-Za-z][A-Za-z0-9-]{0,31}"
"""A pattern of the names of cameras."""


def _named(name: str) -> str:
    if not re.fullmatch(CAMERA_NAME, name):
        raise ValueError(
            f"{name!r}: a camera's name is 1 to 32 ASCII letters, digits and -, the first a letter: it names files"
        )
    if name.lower() in ROLES_OF_A_PAIR:
        raise ValueError(f"{name!r} is the name of a view that every pair may have: choose another")
    return name


Point = tuple[Offset, Offset, Offset]
About = Annotated[
    Annotated[Literal["object", "table", "world"], Tag("[word]")] | Annotated[Point, Tag("[list]")],
    among_kinds("[word]", "[list]"),
]
Angle = Annotated[float, Field(ge=-360, le=360)]
FieldOfView = Annotated[float, Field(ge=0.1, le=175)]
KINDS = ("beside", "ring", "sphere", "poses", "preset")
"""Keys of an entry of `cameras.more` that say where its cameras stand: each has just one."""


class More(Frozen):
    """Further cameras of a scene, by name: of one of the kinds `beside`, `ring`, `sphere`, `poses` and `preset`."""

    name: Annotated[str, AfterValidator(_named)]
    """The `role` of its views and the word in the names of their files."""
    beside: Literal["input", "mirror"] | None = None
    """One camera in each pair, fixed to the input or the mirror camera: stereo."""
    offset_m: Point = (0.0, 0.0, 0.0)
    """Of `beside`: its place along the optical axes of that camera."""
    rotation_deg: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    """Of `beside`: turned about that camera's x, then y, then z axis."""
    ring: Ring | None = None
    """Cameras in a ring."""
    sphere: Sphere | None = None
    """Cameras over a sphere."""
    poses: Folder | None = None
    """A table (.csv, .parquet or .json) of poses, a row a view."""
    preset: Literal["zero123", "syncdreamer", "zero123plus", "lrm", "trellis"] | None = None
    """Cameras as a published method has them (docs/studio.md)."""
    about: About = "object"
    """The point looked at: the middle of the objects, of the table top, the world's origin, or a point of the world."""
    roll_deg: OneOrRange = Range(0.0, 0.0)
    """Turn of each camera about its optical axis."""
    sensor: Sensor | None = None
    """Its pinhole camera; without it that of the camera it is beside, else `cameras.sensor`."""
    fov_deg: FieldOfView | None = None
    """Horizontal field of view, in place of the sensor's fx and fy."""

    @field_validator("sensor")
    @classmethod
    def _is_fixed(cls, sensor: Sensor | None) -> Sensor | None:
        if sensor is not None and sensor.has_ranges:
            raise ValueError("ranges are drawn for input cameras alone: give one number each of fx, fy, cx, cy")
        return sensor

    @model_validator(mode="after")
    def _is_of_one_kind(self) -> "More":
        there = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(there) != 1:
            raise ValueError(
                f"camera {self.name} has {' and '.join(there) or 'none'} of {', '.join(KINDS)}: give one of them"
            )
        aimed = {"about": self.about != "object", "roll_deg": self.roll_deg != Range(0.0, 0.0)}
        if there[0] in ("beside", "poses") and (idle := [key for key, is_set in aimed.items() if is_set]):
            raise ValueError(
                f"camera {self.name}: {there[0]} says where it looks, and {idle[0]} cannot act: leave {idle[0]} out"
            )
        if self.beside is None and (self.offset_m, self.rotation_deg) != ((0.0,) * 3, (0.0,) * 3):
            raise ValueError(f"camera {self.name}: offset_m and rotation_deg are for beside, and it has {there[0]}")
        if self.about != "object" and any(isinstance(kind.radius_m, str) for kind in self.orbits):
            raise ValueError(f"camera {self.name}: radius_m fit frames the objects, so about must be object")
        return self

    @property
    def orbits(self) -> "tuple[Ring | Sphere, ...]":
        """Its rings and spheres, one after another."""
        if self.preset is not None:
            return VIEW_PRESETS[self.preset].orbits
        return tuple(kind for kind in (self.ring, self.sphere) if kind is not None)

    @property
    def pinhole_fov_deg(self) -> float | None:
        """Horizontal field of view where it is given, by the entry or by its preset."""
        if self.fov_deg is None and self.preset is not None:
            return VIEW_PRESETS[self.preset].fov_deg
        return self.fov_deg

    @property
    def count(self) -> int | None:
        """Views in a scene, or for `beside` in a pair; None where a file says it."""
        if self.poses is not None:
            return None
        return 1 if self.beside is not None else sum(each.count for each in self.orbits)


class ViewPreset(NamedTuple):
    """The cameras of a published method.

    fov_deg: horizontal field of view; of: what their distances are measured in, the longest side of the object's bounding box
    or its bounding sphere's radius, which is `unit_m` there.
    """

    fov_deg: float
    of: Literal["side", "sphere"]
    unit_m: float
    orbits: tuple[Ring | Sphere, ...]


def _direction(yaw_deg: float, elevation_deg: float, radius_m: float) -> Ring:
    """One camera, from the direction of the input camera."""
    return Ring(
        count=1,
        inclination_rad=math.radians(elevation_deg),
        start_rad=math.radians(yaw_deg),
        start="input",
        radius_m=radius_m,
    )


LENS_35_OF_32_DEG = 2.0 * math.degrees(math.atan(0.5 * 32.0 / 35.0))
"""Horizontal field of view of Blender's lens of 35 mm before 32 mm."""

VIEW_PRESETS: Mapping[str, ViewPreset] = {
    # cvlab-columbia/zero123, objaverse-rendering/scripts/blender_script.py and ldm/data/simple.py.
    "zero123": ViewPreset(LENS_35_OF_32_DEG, "side", 1.0, (Sphere(count=12, pattern="cube", radius_m=(1.5, 2.2)),)),
    # liuyuan-pal/SyncDreamer, blender_script.py and meta_info/camera-16.pkl: the sixteen targets.
    "syncdreamer": ViewPreset(
        LENS_35_OF_32_DEG,
        "side",
        1.0,
        (Ring(count=16, inclination_rad=math.radians(30.0), radius_m=1.5),),
    ),
    # SUDO-AI-3D/zero123plus, README.md (version 1.2) and issue #73: 0.5 / tan(15 degrees) from a sphere of radius 0.5.
    "zero123plus": ViewPreset(
        30.0,
        "sphere",
        0.5,
        tuple(_direction(30.0 + 60.0 * n, (20.0, -10.0)[n % 2], 0.5 / math.tan(math.radians(15.0))) for n in range(6)),
    ),
    # TencentARC/InstantMesh, issue #13 (LRM's setting) and src/data/objaverse.py: boxes of side 2.
    "lrm": ViewPreset(
        50.0,
        "side",
        2.0,
        (Sphere(count=32, pattern="cube", height_m=(-0.75, 1.6), radius_m=(2.0, 3.5)),),
    ),
    # microsoft/TRELLIS, dataset_toolkits/render.py and utils.py.
    "trellis": ViewPreset(40.0, "side", 1.0, (Sphere(count=150, pattern="trellis", radius_m=2.0),)),
}


class Cameras(Frozen):
    """Every camera of a scene."""

    orbit: Orbit = Orbit()
    """Where input cameras stand."""
    sensor: Sensor = Sensor()
    """The pinhole camera of every view."""
    depth: DepthCamera = DepthCamera()
    """The depth camera that is not aligned with the RGB camera."""
    mirror: Mirror = Mirror()
    """The camera on the other side."""
    more: tuple[More, ...] = ()
    """Further cameras by name: stereo, rings, spheres, poses of one's own."""

    @model_validator(mode="after")
    def _names_once(self) -> "Cameras":
        names = [entry.name.lower() for entry in self.more]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"more names {', '.join(twice)} twice: each camera needs a name of its own")
        if not self.mirror.enabled and (lost := [entry.name for entry in self.more if entry.beside == "mirror"]):
            remedy = "set mirror.enabled: true, or beside: input"
            raise ValueError(f"camera {lost[0]} stands beside the mirror camera, and mirror.enabled is false: {remedy}")
        return self
