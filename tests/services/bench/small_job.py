"""A job with a small camera, for benchmarks whose times nobody asserts."""

SMALL = {
    "name": "small",
    "seed": 5,
    "cameras": {"sensor": {"width": 160, "height": 120, "fx": 131.25, "fy": 131.25, "cx": 80.0, "cy": 60.0}},
    "images": {"patch": {"width": 32, "height": 24}},
    "check": {"raycast_share": 0.0, "mirror_agreement_mm": 5.0},
    "run": {"range_size": 2},
}
