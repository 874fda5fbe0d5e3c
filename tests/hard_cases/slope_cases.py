"""Rows of the table of hard cases: wedges, grooves and rims. Friction holds up to atan 0.49, 26.1 degrees."""

import math
from functools import partial

import trimesh

from schemas.base import Array
from schemas.scene.scene import Table
from schemas.scene.shape import Asset
from tests.hard_cases.bodies import ball, cube, rod
from tests.hard_cases.case import settles
from tests.hard_cases.drops import EDGE_M, Drop, X, Y, level, table_of, turn
from tests.hard_cases.groups import FREE_M, Group, place, prism, put, together
from tests.hard_cases.measures import Measure, Z, below, both, height, leaning, moved
from tests.kit.shapes import asset_of, box

WEDGE_M, WEDGE_KG = 0.25, 20.0
"""Length of a wedge's base, and its mass: what slides on it does not move it."""


def wedge(angle_deg: float) -> Asset:
    """A wedge that falls off towards +x, its lower edge at the origin."""
    return prism([(-WEDGE_M, 0.0), (0.0, 0.0), (-WEDGE_M, WEDGE_M * math.tan(math.radians(angle_deg)))], 0.15, WEDGE_KG)


def on_wedge(asset: Asset, angle_deg: float, turned_deg: float = 0.0) -> Group:
    """Something of which z is up, half-way up a wedge, turned about the wedge's normal, `FREE_M` over it."""
    table, tan = level(), math.tan(math.radians(angle_deg))
    R = turn(Y, angle_deg) @ turn(Z, turned_deg)
    start = put(asset, table, 0.0, (-0.6 * WEDGE_M, 0.0), R)
    points = start.hull.vertices @ R.T + start.T_world_obj[:3, 3] - [0.0, 0.0, table.top.height_m]
    lift = float((-points[:, 0] * tan - points[:, 2]).max()) + FREE_M
    at = start.T_world_obj[:3, 3] + [0.0, 0.0, lift - table.top.height_m]
    return together(table, [place(wedge(angle_deg), table), place(asset, table, at, R)])


# ---------------------------------------------------------------------------------------------- grooves


GROOVE_M = 0.025
"""Depth of a groove with sides at 45 degrees."""


def grooved() -> Table:
    """A slab with a groove along y in its middle."""
    groove = [(-GROOVE_M, 0.0), (0.0, -GROOVE_M), (GROOVE_M, 0.0)]
    outline = [(-EDGE_M, 0.0), *groove, (EDGE_M, 0.0), (EDGE_M, -0.05), (-EDGE_M, -0.05)]
    parts = prism(outline, 1.4).shape.parts
    return table_of(*(trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts))


def in_groove(asset: Asset, R: Array, lowest_m: float) -> Drop:
    """Something over the middle of the groove, its lowest point that high over the groove's bottom, and 1 mm."""
    table = grooved()
    return Drop(put(asset, table, lowest_m + 0.001 - GROOVE_M, R=R), table)


def over_groove_m(radius_m: float) -> float:
    """Height over the table's top of a round thing between the groove's two sides: root 2 radii over its bottom."""
    return math.sqrt(2.0) * radius_m - GROOVE_M


ROUND_M = (math.sqrt(2.0) - 1.0) * 0.02
"""Height of the lowest point of what is round, 20 mm in radius, over the groove's bottom."""


def slides_to_m(turned_deg: float, angle_deg: float = 27.5, half_m: float = 0.025) -> float:
    """Height of a cube's middle where its lowest corner has come to a wedge's toe: there the table may hold it."""
    t, a = math.radians(turned_deg), math.radians(angle_deg)
    return half_m * ((math.cos(t) + math.sin(t)) * math.sin(a) + math.cos(a))


def slid_down() -> Measure:
    """Of the cube on the wedge: it has come to the table, turned on its face as it may be."""
    return below(slides_to_m(45.0) + 0.001, 1)


SLOPES = (
    *(
        settles(
            f"cube on a wedge of 25 degrees{how}",
            both(moved(0.4), leaning(lambda: 25.0, 0.05, body=1)),
            partial(lambda turned: on_wedge(cube(0.05), 25.0, turned), turned),
        )
        for how, turned in (("", 0.0), (", turned by 30 degrees", 30.0))
    ),
    # It slides with g (sin - 0.49 cos) = 0.27 m/s^2, down to the table, and may turn on its face while it does.
    settles("cube on a wedge of 27.5 degrees", slid_down(), lambda: on_wedge(cube(0.05), 27.5)),
    # A column 20 mm wide and 66 high tips at atan (20 / 66) = 16.9 degrees, long before it slides.
    settles(
        "column on a wedge of 15 degrees, of 16.9",
        leaning(lambda: 15.0, 0.05, body=1),
        lambda: on_wedge(asset_of(box(0.02, 0.05, 0.066)), 15.0),
    ),
    settles(
        "column on a wedge of 18.5 degrees, of 16.9",
        below(0.06, 1),
        lambda: on_wedge(asset_of(box(0.02, 0.05, 0.066)), 18.5),
    ),
    settles(
        "cylinder in a groove",
        both(height(over_groove_m(0.02), 0.02), leaning(lambda: 90.0, 0.05)),
        lambda: in_groove(rod(0.02, 0.1, 360), turn(X, 90), ROUND_M),
    ),
    settles(
        "cylinder let go across a groove at 10 degrees",
        both(height(over_groove_m(0.02), 0.02), leaning(lambda: 90.0, 0.05)),
        lambda: in_groove(rod(0.02, 0.1, 360), turn(Z, 10) @ turn(X, 90), 0.021),
    ),
    # A cube on its edge fits the groove: both lower sides lie flat on it. Half its diagonal is over the groove's bottom.
    settles(
        "cube on its edge in a groove",
        both(height(over_groove_m(0.02), 0.02), leaning(lambda: 45.0, 0.05)),
        lambda: in_groove(cube(0.04), turn(Y, 45), 0.0),
    ),
    # A ball's faces lie up to 32 micrometres within its sphere of 40 mm. It may roll along the groove.
    settles(
        "ball in a groove",
        height(over_groove_m(0.02), 0.1),
        lambda: in_groove(ball(0.02), turn(X, 0), ROUND_M),
        tier="minute",
    ),
)
