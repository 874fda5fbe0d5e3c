"""The job file: one tree of frozen models, parsed once. A step gets its own branch and no other.

Every key has a default except `name`; `extra = forbid` everywhere, so a misspelt key is an error and not a silence.
Keys under `run`, and `scenes`, do not change what a scene is: they are outside its settings digest.
"""

import math
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from schemas.base import (
    Frozen,
    Interval,
    NonNegativeInt,
    Positive,
    PositiveInt,
    Range,
    Share,
)
from schemas.job.assets import Assets
from schemas.job.physics import Physics
from schemas.job.preset import PresetName, with_preset
from schemas.job.sensor import SensorEffects
from schemas.job.start import ONE_OBJECT, ObjectCount, Start

Tier = Literal["flat", "raster", "pathtraced"]
Category = Literal["bottle", "camera", "can", "jar", "laptop", "mug", "bowl", "box"]
Focal = Annotated[float, Field(ge=1e-3, le=1e6)]
Principal = Annotated[float, Field(ge=-1e6, le=1e6)]
Reach = Annotated[float, Field(gt=0, le=1e3)]
Offset = Annotated[float, Field(ge=-1e3, le=1e3)]
"""Far beyond any camera, and what its numbers can be without overflow in float32 on the GPU."""
CATEGORIES: tuple[Category, ...] = ("bottle", "camera", "can", "jar", "laptop", "mug", "bowl", "box")


class Orbit(Frozen):
    """Where input cameras stand: spherical coordinates about the centre of the table top [A]."""

    inclination_rad: Interval = Range(0.7, 0.9)
    """Angle of the optical axis below the horizontal."""
    yaw_rad: Interval = Range(-math.pi, math.pi)
    """Direction from the table to the camera."""
    radius_m: Reach = 2.5
    """Distance from the centre of the table top."""


class Sensor(Frozen):
    """A pinhole camera. cx, cy count from the image's left and upper edge: pixel centres lie at +0.5 [A, D]."""

    width: Annotated[int, Field(ge=1, le=4096)] = 640
    """Pixels."""
    height: Annotated[int, Field(ge=1, le=4096)] = 480
    """Pixels."""
    fx: Focal = 525.0
    """Focal length, pixels."""
    fy: Focal = 525.0
    """Focal length, pixels."""
    cx: Principal = 320.0
    """Principal point, pixels from the left edge."""
    cy: Principal = 240.0
    """Principal point, pixels from the upper edge."""


class DepthCamera(Frozen):
    """The depth camera's place in the RGB camera's optical axes, metres; same rotation [A]."""

    enabled: bool = True
    """Whether there are aligned views."""
    offset_m: tuple[Offset, Offset, Offset] = (-0.051, 0.001, -0.001)
    """Translation in the RGB camera's optical axes."""


class Mirror(Frozen):
    """The camera on the other side [A, C]."""

    enabled: bool = True
    """Whether there are mirror views; without them camPoses.csv has one row a pair, with an even id."""
    T_z_m: Reach = 1.3
    """Distance of the mirror camera from the point that it looks at."""
    pivot_depth: Literal["percentile", "median", "nearest"] = "percentile"
    """How d_z, the distance to the object's front surface, is read from the object's stored input depth."""
    percentile: Annotated[float, Field(ge=0, le=100)] = 2.0
    """Of the object's depth pixels, for `pivot_depth: percentile`."""


class Cameras(Frozen):
    """Every camera of a pair."""

    orbit: Orbit = Orbit()
    """Where input cameras stand."""
    sensor: Sensor = Sensor()
    """The pinhole camera of every view."""
    depth: DepthCamera = DepthCamera()
    """The depth camera that is not aligned with the RGB camera."""
    mirror: Mirror = Mirror()
    """The camera on the other side."""


class Patch(Frozen):
    """Size of the crop about each object, pixels [A]."""

    width: PositiveInt = 128
    """Pixels."""
    height: PositiveInt = 96
    """Pixels."""


class Projection(Frozen):
    """How the input cloud is carried into the mirror view."""

    enabled: bool = True
    """Whether there are projected images; they need `cameras.mirror.enabled`."""
    splat: Annotated[int, Field(ge=1, le=15)] = 1
    """Side of the square of pixels that each point fills; odd."""
    hidden_point_removal: bool = False
    """Leave out points whose surface faces away from the mirror camera."""

    @field_validator("splat")
    @classmethod
    def _odd(cls, value: int) -> int:
        if value % 2 == 0:
            raise ValueError(
                f"splat {value} is even: a point's square needs a middle pixel, use {value - 1} or {value + 1}"
            )
        return value


class Images(Frozen):
    """Encodings [C, D]."""

    depth_units_per_m: Positive = 5000.0
    """Units of a depth image in a metre."""
    depth_range_m: Interval = Range(0.2, 8.0)
    """Depth outside this open interval is stored as 0."""
    patch: Patch = Patch()
    """Size of the crop about each object."""
    projection: Projection = Projection()
    """How the input cloud is carried into the mirror view."""
    png_level: Annotated[int, Field(ge=0, le=9)] = 1
    """Compression level of the PNG files; pixels do not change."""

    @model_validator(mode="after")
    def _fits_16_bits(self) -> "Images":
        units = self.depth_range_m.high * self.depth_units_per_m
        if units > 65_535:
            raise ValueError(
                f"depth_range_m ends at {self.depth_range_m.high:g} m, which is {units:.0f} "
                f"units of depth_units_per_m {self.depth_units_per_m:g}: a 16-bit image holds at most 65535"
            )
        return self


class Render(Frozen):
    """RGB."""

    rgb: bool = True
    """Whether there are RGB images; without them no colour is worked out."""
    tier: Tier = "raster"
    """raster: textured floors, a key light with soft shadows, contact shadows, transparent texels cut out, smooth edges;
    flat: albedo and light from two directions, in less than half the time; pathtraced: global illumination, glass and
    metal by Mitsuba, in seconds an image (`./verso extra pathtraced` installs it). Depth and masks are the same in all."""
    samples: Literal[1, 4] = 1
    """Of colour in a pixel that shows an edge, for tier raster: 1 smooths edges by their neighbours, 4 draws them at three
    more points, which takes twice as long. Labels are the pixel centre's either way."""
    path_samples: Annotated[int, Field(ge=1, le=65_536)] = 16
    """Paths through each pixel, for tier pathtraced: time grows with them. They fill a grid of nearly equal
    sides, and are rounded up where they do not: 16 is 4 x 4, 13 becomes 15."""
    path_bounces: Annotated[int, Field(ge=1, le=64)] = 8
    """How often a path may be scattered or cross glass, for tier pathtraced."""


class Check(Frozen):
    """What is checked before a scene is committed."""

    raycast_share: Share = 0.01
    """Share of scenes, chosen by scene id, whose depth and masks are compared with a ray caster, and whose objects are
    released again to see that they stay where they are."""
    mirror_agreement_mm: Positive = 1.0
    """Largest median difference between input depth carried into the mirror view and the mirror depth."""


class Output(Frozen):
    """How files are laid out."""

    layout: Literal["files", "tar"] = "files"
    """`tar`: one tar for each range and category, required on object stores."""


class Run(Frozen):
    """How the work is driven. None of these keys changes a byte of the dataset."""

    workers: PositiveInt | None = None
    """None: the cores that this container may use, or the cluster's."""
    shard_size: PositiveInt | None = None
    """Scenes in a Ray task; rounded up to whole ranges. None: 64, and fewer where that would leave workers idle."""
    range_size: PositiveInt = 16
    """Scenes in a commit; recorded at the first run."""
    max_failure_share: Share = 0.01
    """Above this share of failed scenes the run exits 1, and stops early once that is certain."""
    max_attempts: PositiveInt = 3
    """Tries of a range whose worker dies, before the scene it died in is recorded as an environmental failure."""
    scene_timeout_s: Positive = 120.0
    """A worker that takes longer over one scene is killed."""
    device: Literal["any", "gpu"] = "any"
    """What may draw: `gpu` refuses workers on which OpenGL runs in software, on the CPU."""
    fingerprint: Literal["strict", "record"] = "strict"
    """`strict` refuses workers whose stack makes other bytes; `record` allows them and stores which made what."""


class Job(Frozen):
    """A whole job file."""

    verso: Literal[1] = 1
    """schema_version."""
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    """Names the dataset; the default output folder is data/<name>."""
    preset: PresetName = "balanced"
    """What keys that are not given are: `fast` and `exact` trade errors for time as docs/tradeoff has measured."""
    seed: NonNegativeInt = 0
    """Seed of everything that is drawn in a scene."""
    scenes: PositiveInt = 64
    """How many scenes; more than before extends a dataset."""
    first_scene: NonNegativeInt = 0
    """Id of the first scene."""
    pairs_per_scene: Annotated[int, Field(ge=1, le=1000)] = 1
    """Input and mirror poses of each scene."""
    objects_per_scene: ObjectCount = ONE_OBJECT
    """How many objects lie on the table; a range is drawn from, each number alike. The scene's category is the first's."""
    categories: dict[Category, Positive] = Field(default_factory=lambda: dict.fromkeys(CATEGORIES, 1.0), min_length=1)
    """Weights; a list of names means equal weights."""
    assets: Assets = Assets()
    """Where shapes come from."""
    start: Start = Start()
    """How an object begins."""
    physics: Physics = Physics()
    """How it comes to rest."""
    cameras: Cameras = Cameras()
    """Who looks at it."""
    images: Images = Images()
    """What is stored."""
    render: Render = Render()
    """How RGB looks."""
    sensor: SensorEffects = SensorEffects()
    """What the sensors add to exact images; nothing by default."""
    check: Check = Check()
    """What is checked before a scene is committed."""
    output: Output = Output()
    """How files are laid out."""
    run: Run = Run()
    """How the work is driven: changes no byte of the dataset."""

    @model_validator(mode="before")
    @classmethod
    def _fill(cls, value: object) -> object:
        return with_preset(value) if isinstance(value, dict) else value

    @field_validator("categories", mode="before")
    @classmethod
    def _from_list(cls, value: object) -> object:
        if isinstance(value, list):
            if len(set(map(str, value))) != len(value):
                raise ValueError(f"{value} names a category twice")
            return dict.fromkeys(value, 1.0)
        return value

    @model_validator(mode="after")
    def _agrees(self) -> "Job":
        if self.images.projection.enabled and not self.cameras.mirror.enabled:
            raise ValueError(
                "images.projection.enabled is true and cameras.mirror.enabled is false: what is projected is what the "
                "mirror camera would see; set images.projection.enabled: false too"
            )
        if self.sensor.changes_rgb and not self.render.rgb:
            raise ValueError(
                "render.rgb is false and sensor asks for an effect on RGB: leave out sensor.distortion, sensor.rgb_noise "
                "and sensor.exposure"
            )
        return self

    @property
    def stop_scene(self) -> int:
        """One past the last scene id."""
        return self.first_scene + self.scenes
