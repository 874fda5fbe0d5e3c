"""Pure: the kinds of bottles and their proportions."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Kind:
    """Ranges of one kind of bottle. Lengths are shares of the height but for `height_m`; radii are half widths."""

    height_m: tuple[float, float]
    radius: tuple[float, float]
    body: tuple[float, float]
    """Where the straight body ends."""
    shoulder: tuple[float, float]
    """Height of the shoulder."""
    neck: tuple[float, float]
    """Radius of the neck, as a share of the body's."""
    cap: str
    """`cork`, `crown`, `screw`, `wide` (as wide as the shoulder lets it be) or `foil`."""
    material: str
    """`glass`, `clear`, `plastic` or `metal`."""
    sections: tuple[int, ...] = (0,)
    """Squareness of the body's section."""
    depth: tuple[float, float] = (1.0, 1.0)
    """Depth of the section as a share of its width."""
    ribs: float = 0.0
    """Share of bottles with grooves around the body."""


KINDS = (
    # bordeaux, burgundy, beer, soda, water, sauce, oil, shampoo, medicine, flask
    Kind((0.28, 0.32), (0.118, 0.13), (0.58, 0.64), (0.09, 0.13), (0.36, 0.4), "foil", "glass"),
    Kind((0.28, 0.31), (0.13, 0.145), (0.36, 0.44), (0.28, 0.34), (0.34, 0.4), "foil", "glass"),
    Kind((0.2, 0.26), (0.118, 0.14), (0.48, 0.58), (0.15, 0.22), (0.38, 0.46), "crown", "glass"),
    Kind((0.2, 0.33), (0.13, 0.155), (0.55, 0.66), (0.18, 0.26), (0.36, 0.44), "screw", "clear", ribs=0.4),
    Kind((0.19, 0.31), (0.13, 0.17), (0.62, 0.74), (0.12, 0.18), (0.36, 0.46), "screw", "clear", (0, 0, 1), ribs=0.7),
    Kind((0.16, 0.24), (0.13, 0.17), (0.5, 0.62), (0.12, 0.2), (0.36, 0.5), "screw", "glass", (0, 1, 2), (0.75, 1.0)),
    Kind((0.24, 0.32), (0.105, 0.13), (0.58, 0.68), (0.1, 0.16), (0.36, 0.44), "cork", "glass", (0, 1, 2)),
    Kind((0.15, 0.24), (0.17, 0.24), (0.68, 0.8), (0.06, 0.12), (0.4, 0.6), "wide", "plastic", (0, 1), (0.5, 0.8)),
    Kind((0.08, 0.13), (0.22, 0.28), (0.68, 0.75), (0.06, 0.09), (0.6, 0.75), "wide", "glass"),
    Kind((0.2, 0.28), (0.125, 0.16), (0.72, 0.8), (0.05, 0.1), (0.6, 0.85), "wide", "metal"),
)
