"""The `sensor` branch of a job: effects of a real sensor on images, each off by default."""

from typing import Annotated, Literal

from pydantic import Field

from schemas.base import Frozen, Interval, NonNegative, Positive, Range, Share


class DepthNoise(Frozen):
    """Noise of a time-of-flight depth camera. Every default is the preset `azure_kinect`.

    What is published: Microsoft's specification (Azure Kinect DK hardware specifications) gives a random error of at
    most 17 mm standard deviation, a systematic error below 11 mm + 0.1 % of the distance, and 0.5 to 3.86 m of operating
    range in the mode NFOV unbinned; Tolgyessy et al. 2021 (Sensors 21(2):413) confirm the standard deviation of at most
    17 mm and the distance error below 11 mm up to 3.5 m, and describe flying pixels at depth edges.

    What is assumed: that the random error reaches those 17 mm at the far end of the range, so that the preset is an upper
    bound and not a typical device; that it grows with the square of the distance and with 1 / cos of the angle of
    incidence, as the returned light falls; and every number that says so below.
    """

    preset: Literal["azure_kinect"] = "azure_kinect"
    """Names the defaults of this branch: mode NFOV unbinned."""
    axial_m: NonNegative = 0.0
    """Standard deviation along the optical axis that does not depend on the distance, metres [assumed]."""
    axial_per_m: NonNegative = 17e-3 / 3.86**2
    """The standard deviation at z grows by this times z squared: 17 mm at 3.86 m, and 1.1 mm at 1 m."""
    incidence_power: NonNegative = 1.0
    """The standard deviation is divided by the cosine of the angle of incidence to this power [assumed]."""
    grazing_deg: Annotated[float, Field(gt=0, le=90)] = 80.0
    """Pixels that see their surface at a larger angle of incidence have no depth [assumed]."""
    offset_m: float = 0.0
    """Systematic error, metres. 0: the specification bounds it by 11 mm, and leaves its sign open."""
    offset_share: Annotated[float, Field(gt=-1, lt=1)] = 0.0
    """Systematic error as a share of the distance; the specification bounds it by 0.001."""
    lateral_px: NonNegative = 0.4
    """Standard deviation, pixels, of the shift of a pixel's sample near a depth edge [assumed]."""
    edge_step_m: Positive = 0.03
    """Smallest second difference of 1/depth, times depth squared, metres, that counts as an edge [assumed]."""
    edge_px: Annotated[int, Field(ge=1, le=8)] = 1
    """Reach of an edge's effects, pixels [assumed]."""
    flying_share: Share = 0.3
    """Share of the pixels at an edge whose depth is a mixture of the surfaces before and behind [assumed]."""
    edge_dropout: Share = 0.2
    """Share of the pixels at an edge that have no depth [assumed]."""
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
    """Electrons at full white: the variance of the shot noise is the mean over this, in units of white."""
    read_noise_e: NonNegative = 3.0
    """Standard deviation of the read noise, electrons."""


class Exposure(Frozen):
    """Gain of RGB before it is encoded; what was white already stays no brighter than it was stored."""

    stops: Interval = Range(-1.0, 1.0)
    """Drawn uniformly for each view: linear light is multiplied by 2 to this power. Equal ends fix it."""


class SensorEffects(Frozen):
    """What the sensors add to exact images; masks and labels stay exact."""

    depth_noise: DepthNoise | None = None
    """Noise of a time-of-flight camera in depth; `{}` for the preset. d_z and the projection follow stored depth."""
    distortion: Distortion | None = None
    """Lens distortion of stored RGB."""
    rgb_noise: RgbNoise | None = None
    """Shot and read noise of RGB."""
    exposure: Exposure | None = None
    """Exposure of RGB."""

    @property
    def changes_rgb(self) -> bool:
        """Whether any effect on RGB is on."""
        return any(effect is not None for effect in (self.distortion, self.rgb_noise, self.exposure))
