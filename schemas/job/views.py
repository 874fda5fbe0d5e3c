"""The branches of a job that shape its images: `images`, `render`, `sensor` and `targets`.

Targets are what networks are trained on beside the images of the article, by view and by shape.
"""

from typing import Annotated, Literal

from pydantic import Field, Tag, field_validator, model_validator

from schemas.base import Frozen, Interval, NonNegative, Positive, PositiveInt, Range, Share, among_kinds


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
    """Compression level of PNG files. At 2 a scene's images are a quarter smaller and take 12 ms more, at 6 a third and 70 ms."""

    @model_validator(mode="after")
    def _fits_16_bits(self) -> "Images":
        units = self.depth_range_m.high * self.depth_units_per_m
        if units > 65_535:
            bound = (
                f"{units:.0f} units of depth_units_per_m {self.depth_units_per_m:g}: a 16-bit image holds at most 65535"
            )
            raise ValueError(f"depth_range_m ends at {self.depth_range_m.high:g} m, which is {bound}")
        return self


Tier = Literal["flat", "raster", "pathtraced"]


class Render(Frozen):
    """RGB."""

    rgb: bool = True
    """Whether there are RGB images; without them no colour is computed."""
    tier: Tier = "raster"
    """raster: textures, soft shadows of a key light, contact shadows, smooth edges; flat: albedo and two lights, in less than
    half the time; pathtraced: global illumination, glass and metal by Mitsuba, in seconds an image."""
    samples: Literal[1, 4] = 1
    """Colour samples of a pixel at an edge, for tier raster: 1 smooths by neighbours, 4 takes twice the time."""
    path_samples: Annotated[int, Field(ge=1, le=65_536)] = 16
    """Paths through each pixel, for tier pathtraced; rounded up to a grid of nearly equal sides."""
    path_bounces: Annotated[int, Field(ge=1, le=64)] = 8
    """Most scatterings and glass crossings of a path, for tier pathtraced."""


Background = Annotated[
    Annotated[Literal["transparent"], Tag("[word]")] | Annotated[tuple[Share, Share, Share], Tag("[list]")],
    among_kinds("[word]", "[list]"),
]


class Studio(Frozen):
    """How an object stands for itself, with `scene: studio`: on nothing, so that there is no table, fall, floor or shadow."""

    scale: Literal["metric", "unit_sphere", "unit_cube"] = "metric"
    """metric: its own size; unit_sphere: within a sphere of radius `size_m`; unit_cube: its box's longest side is `size_m`."""
    size_m: Annotated[float, Field(ge=1e-3, le=100)] = 1.0
    """Of `unit_sphere` and `unit_cube`."""
    light: Literal["even", "three_point", "environment"] = "even"
    """even: from everywhere, no highlights; three_point: key, fill and rim; environment: a bright sky over a ground."""
    background: Background = "transparent"
    """transparent: RGB has alpha, the share of each pixel that the object covers; or one sRGB colour, [1, 1, 1] for white."""


class DepthNoise(Frozen):
    """Noise of a time-of-flight depth camera. Every default is the Azure Kinect's in mode NFOV unbinned.

    What is published: Microsoft's specification (Azure Kinect DK hardware specifications) gives a random error of at
    most 17 mm standard deviation, a systematic error below 11 mm + 0.1 % of the distance, and 0.5 to 3.86 m of operating
    range in the mode NFOV unbinned; Tolgyessy et al. 2021 (Sensors 21(2):413) confirm the standard deviation of at most
    17 mm and the distance error below 11 mm up to 3.5 m, and describe flying pixels at depth edges.

    What is assumed: that the random error reaches those 17 mm at the far end of the range, so that the defaults are an upper
    bound and not a typical device; that it grows with the square of the distance and with 1 / cos of the angle of
    incidence, as the returned light falls; and every number that says so below.
    """

    axial_m: NonNegative = 0.0
    """Standard deviation along the optical axis at distance 0 [assumed]."""
    axial_per_m: NonNegative = 17e-3 / 3.86**2
    """The standard deviation grows by this times z squared."""
    grazing_deg: Annotated[float, Field(gt=0, le=90)] = 80.0
    """Pixels beyond this angle of incidence have no depth [assumed]."""
    offset_m: float = 0.0
    """Systematic error. 0: the specification bounds it by 11 mm, and leaves its sign open."""
    offset_share: Annotated[float, Field(gt=-1, lt=1)] = 0.0
    """Systematic error as a share of the distance; the specification bounds it by 0.001."""
    lateral_px: NonNegative = 0.4
    """Standard deviation, pixels, of the shift of a pixel's sample near a depth edge [assumed]."""
    edge_px: Annotated[int, Field(ge=1, le=8)] = 1
    """Reach of an edge's effects, pixels [assumed]."""
    flying_share: Share = 0.3
    """Share of edge pixels whose depth mixes the surfaces before and behind [assumed]."""
    edge_dropout: Share = 0.2
    """Share of edge pixels without depth [assumed]."""
    range_m: Interval = Range(0.5, 3.86)
    """Depth outside this interval is not measured."""


class Distortion(Frozen):
    """Lens distortion of the RGB camera: OpenCV's five coefficients. Depth and segment stay those of the pinhole camera.

    Stored RGB is what the lens draws; where it sees past the edge of the pinhole's picture it is black.
    """

    k1: float = 0.0
    """Radial, second power."""
    k2: float = 0.0
    """Radial, fourth power."""
    p1: float = 0.0
    """Tangential."""
    p2: float = 0.0
    """Tangential."""
    k3: float = 0.0
    """Radial, sixth power."""


class RgbNoise(Frozen):
    """Shot noise and read noise of the RGB sensor, in linear light; both numbers are of an assumed small sensor."""

    full_well_e: Positive = 4000.0
    """Electrons at full white: the variance of shot noise is the mean over this, in units of white."""
    read_noise_e: NonNegative = 3.0
    """Standard deviation of the read noise, electrons."""


class Exposure(Frozen):
    """Gain of RGB before it is encoded; what was white already stays no brighter than it was stored."""

    stops: Interval = Range(-1.0, 1.0)
    """Drawn uniformly for each view: linear light is multiplied by 2 to this power. Equal ends fix it."""


class SensorEffects(Frozen):
    """What the sensors add to exact images; masks and labels stay exact."""

    depth_noise: DepthNoise | None = None
    """Noise of a time-of-flight camera in depth; `{}` for the Azure Kinect's. d_z and the projection follow stored depth."""
    distortion: Distortion | None = None
    """Lens distortion of stored RGB."""
    rgb_noise: RgbNoise | None = None
    """Shot and read noise of RGB."""
    exposure: Exposure | None = None
    """Exposure of RGB."""

    @property
    def changes_rgb(self) -> bool:
        """Whether any effect on RGB is on: any but that on depth."""
        return any(name != "depth_noise" and effect is not None for name, effect in self)


ViewTarget = Literal["normals", "coordinates", "albedo", "covisible", "amodal", "layers"]
ShapeTarget = Literal["surface", "volume"]

MOST_LAYERS = 16
"""Surfaces along a pixel's ray that are stored at most; one of the images `back` shows the last of however many there are."""


class Targets(Frozen):
    """Images of drawn views, and samples of shapes; none by default. Sensor effects never change them."""

    views: tuple[ViewTarget, ...] = ()
    """Image targets of input, aligned and mirror views: normals, coordinates, albedo, covisible, amodal, layers."""
    smooth: bool = False
    """Whether `normals` are interpolated between vertices (shading normals), not those of the faces."""
    layers: Annotated[int, Field(ge=1, le=MOST_LAYERS)] = 4
    """Surfaces that `layers` stores along a pixel's ray, from the front, beside the last one."""
    shape: tuple[ShapeTarget, ...] = ()
    """Samples of each shape in assets/<category>/<instance>.npz: surface, volume."""
    points: Annotated[int, Field(ge=1, le=10_000_000)] = 100_000
    """Number of points of each of them."""

    @field_validator("views", "shape")
    @classmethod
    def _once(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) < len(names):
            raise ValueError(f"names a target twice: {', '.join(names)}")
        return names
