"""The preset of the depth camera's noise: what a typical Azure Kinect at 0.5 to 1.5 m adds to exact depth.

**Published.** Microsoft bounds the random error by 17 mm and the systematic error by 11 mm + 0.1 % of the distance over the
whole range of the mode NFOV unbinned, 0.5 to 3.86 m. Tolgyessy et al. 2021 (Sensors 21(2):413) confirm both bounds up to
3.5 m, find the noise lowest near the middle of the image and at short range, and describe pixels that fly between a surface
and what is behind it. Kurillo et al. 2022 (Sensors 22(7):2469) see the random error grow with the distance.

**Assumed.** The numbers below are no fit of a published table. They are a device of the usual kind at arm's length, far inside
those bounds; what scenes have (schemas/job/views.py) is the upper bound.
"""

from schemas.job.captures import KinectDepthNoise
from schemas.job.views import DepthNoise

AXIAL_M, AXIAL_PER_M = 0.0008, 0.0005
"""sigma(z) = 0.8 mm + 0.5 mm z^2 (z in metres), over the cosine of incidence: 1.1 mm at 0.8 m and 1.3 mm at 1 m."""

OFFSET_M, OFFSET_SHARE = 0.0015, 0.001
"""bias(z) = 1.5 mm + 0.1 % of z: 2.3 mm at 0.8 m."""

STEP_M = 0.001
"""The device stores whole millimetres before anything is registered."""


def kinect_noise(spec: KinectDepthNoise) -> DepthNoise:
    """The settings of the depth sensor. `times` multiplies every random error, shares of pixels up to 1; `bias_m` is added.

    Edge mixing: of the pixels at a depth edge 0.3 fly between its surfaces and 0.2 have no depth; samples shift by 0.4 px.
    """
    usual = DepthNoise()
    return usual.model_copy(
        update={
            "axial_m": spec.times * AXIAL_M,
            "axial_per_m": spec.times * AXIAL_PER_M,
            "lateral_px": spec.times * usual.lateral_px,
            "flying_share": min(spec.times * usual.flying_share, 1.0),
            "edge_dropout": min(spec.times * usual.edge_dropout, 1.0),
            "offset_m": OFFSET_M + spec.bias_m,
            "offset_share": OFFSET_SHARE,
        }
    )
