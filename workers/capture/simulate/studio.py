"""What a virtual capture photographs, by what and from where: the object on its board, the Azure Kinect, the camera's path."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.capture import DepthCamera
from schemas.errors import CaptureError
from schemas.job.captures import Board, RegistrationError, Simulate
from schemas.job.look import Look
from schemas.job.views import Distortion
from schemas.scene.scene import EffectPlan, Placed, Walls
from schemas.scene.shape import (
    REGION_FLOOR,
    REGION_TABLE,
    Appearance,
    Asset,
    Material,
    Part,
    Shape,
)
from schemas.scene.view import Intrinsics
from workers.assets.catalogue import Catalogue
from workers.assets.look.appearance import draw_appearance
from workers.assets.look.surroundings import require_inside
from workers.capture.board import TOUCHING_M, board_geometry, marker_cells, marker_corners
from workers.geometry.camera import orbit_pose
from workers.geometry.frames import UP, pose, rotation_about, translation
from workers.geometry.pixels import undistort
from workers.scene.chance import SceneChance, Stream
from workers.scene.draw.surround import enclose
from workers.scene.effects import plan_capture


def place_object(asset: Asset, rng: np.random.Generator) -> Pose:
    """T_board_obj [4, 4]: upright in the middle of the board, at any angle, its lowest point at exactly z = 0."""
    yaw = rng.uniform(-math.pi, math.pi)
    lowest = float(asset.shape.vertices[:, 2].min())
    return frozen_array(pose(rotation_about(UP, yaw), np.array([0.0, 0.0, -lowest])))


def true_board(board: Board, simulate: Simulate) -> Board:
    """The board as large as it was printed: nominal sizes times `print_scale`, whatever a ruler is said to show."""
    scale = 1.0 if simulate.print_scale is None else simulate.print_scale
    return board.model_copy(update={"measured_ruler_m": scale * board.ruler_m})


THICKNESS_M = 0.005
"""Of the board below its print: foam board [assumed]."""

PAPER, INK = (0.91, 0.91, 0.90, 1.0), (0.20, 0.20, 0.21, 1.0)
"""sRGB of paper and of a laser printer's black: 80 % and 3 % of the light [assumed]."""


def board_body(board: Board) -> Shape:
    """A closed box in the board frame, metres, its print at z = 0; sizes are those of `board_geometry`.

    Faces share their vertices along every edge of the print of a grid, so that no view shows a gap between them. Other
    markers lie over their paper, those out of the plane on plates of their own.
    """
    if board.markers:
        return _layout_body(board)
    across, up, black = _cells(board)
    vertices, quads = _grid(across, up)
    sides, low = _sides(vertices, len(across), len(up))
    paper, ink = np.concatenate([quads[~black], sides]), quads[black]
    whole = np.concatenate([vertices, low])
    return _printed(whole, paper, whole, ink, closed=True)


def _printed(
    paper: Array, paper_quads: NDArray[np.int32], ink: Array, ink_quads: NDArray[np.int32], closed: bool
) -> Shape:
    return Shape(
        (
            Part("paper", frozen_array(paper), _triangles(paper_quads), Material(PAPER, roughness=1.0)),
            Part("ink", frozen_array(ink), _triangles(ink_quads), Material(INK, roughness=1.0)),
        ),
        closed=closed,
    )


INK_M = 0.00003
"""Of ink above its paper: more than a z-buffer confuses, and too little to be seen."""

AROUND = frozen_array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""Corners of a square, clockwise as seen from the front with y down."""

PLATE_M = 0.002
"""Thickness of the plate behind a marker that stands out of the plane."""


def _layout_body(board: Board) -> Shape:
    """Ink at the places of markers and squares, over the board's sheet and over plates a bit wider than their markers."""
    geometry, half = board_geometry(board), 0.5 * board.scale * np.array([board.width_m, board.height_m])
    x, y = half
    sheet = np.array([[-x, y, 0.0], [x, y, 0.0], [x, -y, 0.0], [-x, -y, 0.0]])
    boxes, ink = [_box_behind(sheet, THICKNESS_M)], [geometry.squares]
    for cells, corners in zip(marker_cells(board), geometry.corners, strict=True):
        if np.abs(corners[:, 2]).max() > TOUCHING_M:
            wider = AROUND + (2.0 * AROUND - 1.0) / len(cells)  # by one bit of white on each side
            boxes.append(_box_behind(_on_quad(corners, wider), PLATE_M))
        row, column = np.nonzero(cells)
        places = np.stack([column, row], axis=1)[:, None] + AROUND
        ink.append(_on_quad(corners, places / len(cells)))
    quads = np.concatenate(ink)[:, ::-1]  # counter-clockwise as seen from the front
    solid = np.concatenate(boxes)
    numbers = [np.arange(4 * len(some), dtype=np.int32).reshape(-1, 4) for some in (solid, quads)]
    return _printed(solid.reshape(-1, 3), numbers[0], quads.reshape(-1, 3), numbers[1], closed=False)


def _on_quad(corners: Array, places: Array) -> Array:
    """[..., 3]: points of a parallelogram at shares [..., 2] of its upper and its left edge."""
    right, down = corners[1] - corners[0], corners[3] - corners[0]
    return corners[0] + places[..., :1] * right + places[..., 1:] * down


def _box_behind(face: Array, thickness_m: float) -> Array:
    """[6, 4, 3]: the faces of a box, counter-clockwise from outside, whose front lies `INK_M` behind a quad [4, 3]."""
    into = np.cross(face[1] - face[0], face[3] - face[0])
    into /= np.linalg.norm(into)
    front, back = face + INK_M * into, face + thickness_m * into
    sides = [[front[k], front[(k + 1) % 4], back[(k + 1) % 4], back[k]] for k in range(4)]
    return np.array([front[::-1], back, *sides])


def _cells(board: Board) -> tuple[Array, Array, NDArray[np.bool_]]:
    """(x of the grid lines ascending [X], y of the grid lines ascending [Y], black cells [Y - 1, X - 1])."""
    bits = marker_cells(board)
    side = bits.shape[1]
    corners = marker_corners(board)[..., :2].reshape(board.rows, board.columns, 4, 2)
    edges = np.arange(side + 1) / side
    x, y = (
        first[:, None] * (1.0 - edges) + last[:, None] * edges
        for first, last in ((corners[0, :, 0, 0], corners[0, :, 1, 0]), (corners[:, 0, 0, 1], corners[:, 0, 3, 1]))
    )
    half = 0.5 * board.scale * np.array([board.width_m, board.height_m])
    across, up = (np.unique([-end, *lines.ravel(), end]) for end, lines in zip(half, (x, y), strict=True))
    black = np.zeros((len(up) - 1, len(across) - 1), np.bool_)
    for number, cells in enumerate(bits):
        row, column = divmod(number, board.columns)
        i, j = np.searchsorted(up, y[row, -1]), np.searchsorted(across, x[column, 0])
        black[i : i + side, j : j + side] = cells[::-1]
    return across, up, black


def _grid(across: Array, up: Array) -> tuple[Array, NDArray[np.int32]]:
    """(vertices [Y * X, 3] at z = 0, the four corners [Y - 1, X - 1, 4] of each cell counter-clockwise from above)."""
    y, x = np.meshgrid(up, across, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    number = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    return vertices, np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=2)


def _sides(vertices: Array, columns: int, rows: int) -> tuple[NDArray[np.int32], Array]:
    """(quads of the walls and of the underside, the vertices [R, 3] below the rim that they need)."""
    number = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    low = vertices[rim] - [0.0, 0.0, THICKNESS_M]
    below = len(vertices) + np.arange(len(rim), dtype=np.int32)
    after, after_below = np.roll(rim, -1), np.roll(below, -1)
    walls = np.stack([rim, below, after_below, after], axis=1)
    a, b, c = 0, columns - 1, columns - 1 + rows - 1
    d = c + columns - 1
    underside = below[[a, d, c, b]][None, :]
    return np.concatenate([walls, underside]), low


def _triangles(quads: NDArray[np.int32]) -> NDArray[np.int32]:
    """[2 Q, 3] of quads [Q, 4]."""
    return frozen_array(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), np.int32)


HEIGHT_M = 0.0003
"""Of a slip above the print: paper that does not lie quite flat."""

SIDE = (0.4, 0.8)
"""Shortest and longest side of a slip, in sides of a marker."""

YELLOW = (0.93, 0.86, 0.45, 1.0)
"""sRGB."""


def cover_markers(share: float, board: Board, rng: np.random.Generator) -> Shape | None:
    """Level slips in the board frame, metres, one over a part of each chosen marker; None where none is chosen."""
    corners = marker_corners(board)
    corners = corners[np.abs(corners[..., 2]).max(axis=1) == 0.0]  # those that lie on the board
    chosen = np.sort(rng.permutation(len(corners))[: round(share * len(corners))])
    if not len(chosen):
        return None
    slips = np.stack([_slip(corners[m], rng) for m in chosen])
    vertices = np.dstack([slips, np.full((*slips.shape[:2], 1), HEIGHT_M)]).reshape(-1, 3)
    faces = _triangles(np.arange(len(vertices), dtype=np.int32).reshape(-1, 4))
    return Shape((Part("slips", frozen_array(vertices), faces, Material(YELLOW, roughness=1.0)),))


def _slip(corners: Array, rng: np.random.Generator) -> Array:
    """[4, 2]: a turned rectangle whose middle lies on a marker; counter-clockwise from above."""
    side = float(np.linalg.norm(corners[1] - corners[0]))
    middle = corners.mean(axis=0)[:2] + side * rng.uniform(-0.5, 0.5, 2)
    half = 0.5 * side * rng.uniform(*SIDE, 2)
    turn = rng.uniform(0.0, math.pi)
    u, v = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    return np.stack([middle + a * half[0] * u + b * half[1] * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


COLOR = Intrinsics(width=1920, height=1080, fx=912.37, fy=912.25, cx=961.44 + 0.5, cy=548.29 + 0.5)
"""The article's camera. Its principal point (961.44, 548.29) counts from the first pixel's centre."""

DEPTH = Intrinsics(width=640, height=576, fx=503.85, fy=503.74, cx=321.5 + 0.5, cy=329.0 + 0.5)
"""Mode NFOV unbinned: the size is Microsoft's. The rest is one published calibration of a device (MicrosoftDocs/azure-docs
#76396: 0.49204, 0.49193, 0.50148 and 0.49705 of 1024 pixels), of whose 1024 x 1024 pixels this mode is assumed to be the part
from (192, 180) on. Its lens is left out."""

DEPTH_POSITION_M = (-0.032, -0.002, 0.004)
"""Of the depth camera in the colour camera's optical frame: assumed, near published calibrations."""

DEPTH_TILT_DEG = 6.0
"""The depth camera looks down from the colour camera's axis by so much (Microsoft's specification)."""


class Rig(NamedTuple):
    """Both cameras of one device: pinholes with pixel centres at +0.5."""

    color: Intrinsics
    depth: DepthCamera


def make_rig(image_scale: float) -> Rig:
    """The device with all images `image_scale` times as large."""
    rotation = rotation_about(np.array([1.0, 0.0, 0.0]), -math.radians(DEPTH_TILT_DEG))
    T_color_depth = frozen_array(pose(rotation, np.array(DEPTH_POSITION_M)))
    return Rig(
        scale_intrinsics(COLOR, image_scale),
        DepthCamera(scale_intrinsics(DEPTH, image_scale), frozen_array(np.zeros(8)), T_color_depth),
    )


def scale_intrinsics(k: Intrinsics, scale: float) -> Intrinsics:
    """The same field of view on an image `scale` times as large, at least 1 pixel wide and high."""
    width, height = (max(round(side * scale), 1) for side in (k.width, k.height))
    return Intrinsics(width=width, height=height, fx=k.fx * scale, fy=k.fy * scale, cx=k.cx * scale, cy=k.cy * scale)


def assumed_device(device: DepthCamera, error: RegistrationError | None) -> DepthCamera:
    """The depth camera as its calibration has it: the true one without an error.

    With one, it is taken to stand `shift_m` elsewhere and to be turned by `turn_deg` about the vertical of the image, both in
    the colour camera's axes: T_error T_color_depth.
    """
    if error is None:
        return device
    turn = rotation_about(np.array([0.0, 1.0, 0.0]), math.radians(error.turn_deg))
    T_error = pose(turn, np.array(error.shift_m))
    return replace(device, T_color_depth=frozen_array(T_error @ device.T_color_depth))


MARGIN_PX = 2
"""Width of the wider picture beyond what the lens sees, for samples beside a pixel's centre."""

WIDEST = 2.0
"""A pinhole picture that must be more than so many times as wide or high belongs to no lens of this camera."""


def pinhole_lookup(lens: Distortion, k: Intrinsics) -> tuple[Intrinsics, Array, Array]:
    """(a pinhole camera that sees all that the lens does, u [H, W] and v [H, W] in its image of each stored pixel's centre).

    Raises CaptureError where the lens folds over within the image, or needs a picture more than `WIDEST` times as large.
    """
    rows, columns = np.mgrid[0 : k.height, 0 : k.width]
    u, v = undistort(columns + 0.5, rows + 0.5, lens, k)
    if not (np.isfinite(u).all() and np.isfinite(v).all()):
        raise CaptureError("lens", f"the lens {lens} folds over within the image: make its coefficients smaller")
    left, top = math.floor(u.min()) - MARGIN_PX, math.floor(v.min()) - MARGIN_PX
    right, bottom = math.ceil(u.max()) + MARGIN_PX, math.ceil(v.max()) + MARGIN_PX
    if right - left > WIDEST * k.width or bottom - top > WIDEST * k.height:
        size = f"{right - left} x {bottom - top}"
        raise CaptureError("lens", f"the lens {lens} needs a pinhole picture of {size}: make its coefficients smaller")
    update = {"width": right - left, "height": bottom - top, "cx": k.cx - left, "cy": k.cy - top}
    return k.model_copy(update=update), u - left, v - top


FINER = 3.0
"""The floor's pattern is so many times as fine as in a scene: a table top is looked at from nearby."""


Around = tuple[Look, Catalogue]
"""What the job puts around the board, and where its pictures are."""


@dataclass(frozen=True, eq=False)
class Studio:
    """What is photographed and by what; the board lies on the floor of the world, z up.

    `simulate` has the effects that run, and `effects` is the plan of drawing. T_world_board [4, 4]: the board frame lies on top
    of the board. `drawn_color` is the pinhole camera that the colour image
    is drawn with: `rig.color`, or a wider one that `lookup` bends into it. `walls` of a room, and what was drawn of `look`.
    """

    simulate: Simulate
    effects: EffectPlan
    things: tuple[Placed, ...]
    appearance: Appearance
    rig: Rig
    T_world_board: Pose
    chance: SceneChance
    drawn_color: Intrinsics
    lookup: tuple[Array, Array] | None
    walls: Walls | None
    surroundings: Mapping[str, object]


def build_studio(
    simulate: Simulate, board: Board, thing: Placed, chance: SceneChance, around: Around | None = None
) -> Studio:
    """The floor, the board on it, and `thing`, posed in the board frame, in their light.

    Raises CaptureError for the lens, StartError where the board does not fit into the room.
    """
    floor, appearance = draw_appearance(chance.stream(Stream.APPEARANCE), "raster")
    parts = (part if part.uv is None else replace(part, uv=frozen_array(FINER * part.uv)) for part in floor.parts)
    floor, walls, surroundings = replace(floor, parts=tuple(parts)), None, dict[str, object]()
    if around is not None:
        floor, walls, surroundings = enclose(*around, chance, floor, appearance)
    T_world_board = frozen_array(translation(0.0, 0.0, THICKNESS_M))
    printed, rig = true_board(board, simulate), make_rig(simulate.image_scale)
    body, things = board_body(printed), [Placed(REGION_FLOOR, floor, frozen_array(np.eye(4)))]
    if walls is not None:
        require_inside(walls, "board", body.vertices)
        things.append(Placed(REGION_FLOOR, walls.shape, frozen_array(np.eye(4))))
    things.append(Placed(REGION_TABLE, body, T_world_board))
    if simulate.hidden_markers is not None:
        slips = cover_markers(simulate.hidden_markers, printed, chance.stream(Stream.HIDDEN_MARKERS))
        things += [] if slips is None else [Placed(REGION_TABLE, slips, T_world_board)]
    things.append(replace(thing, T_world_shape=frozen_array(T_world_board @ thing.T_world_shape)))
    drawn, lookup = rig.color, None
    if simulate.distortion is not None:
        drawn, *places = pinhole_lookup(simulate.distortion, rig.color)
        lookup = places[0], places[1]
    return Studio(
        simulate=simulate,
        effects=plan_capture(simulate),
        things=tuple(things),
        appearance=appearance,
        rig=rig,
        T_world_board=T_world_board,
        chance=chance,
        drawn_color=drawn,
        lookup=lookup,
        walls=walls,
        surroundings=surroundings,
    )


VIEWS_PER_TURN = 14
"""A turn around the object at one height has about as many views, and a path has at most `MOST_TURNS`."""

MOST_TURNS = 3

ROLL_DEG = 12.0
"""Standard deviation of the roll of the hand-held camera."""

AIM_M = 0.02
"""Standard deviation of the point that the camera looks at about the object's middle."""

JITTER = 0.25
"""Share of an irregular step from view to view in what otherwise changes smoothly."""


def plan_path(simulate: Simulate, target: Array, rng: np.random.Generator) -> Array:
    """[V, 4, 4] float64: poses in the frame of `target` [3], whose z points up, optical frame.

    The camera goes around the target up to three times, higher each time, looks at it and rolls. Its distance and its
    inclination stay within the intervals of `simulate`; the roll is normal.
    """
    views = simulate.views
    turns = min(max(round(views / VIEWS_PER_TURN), 1), MOST_TURNS)
    time = (np.arange(views) + 0.5) / views
    yaw0, way = rng.uniform(-math.pi, math.pi), rng.choice([-1.0, 1.0])
    step = 2.0 * math.pi * turns / views
    yaw = yaw0 + way * (2.0 * math.pi * turns * time + JITTER * step * rng.uniform(-1.0, 1.0, views))
    level = (_climb(time, turns) + 0.5 * _sway(time, rng)) / turns
    inclination = _within(simulate.inclination_rad, level)
    distance = _within(simulate.distance_m, 0.5 + 0.5 * _sway(time, rng))
    roll = np.radians(ROLL_DEG) * _normal_sway(time, rng)
    aim = target + AIM_M * rng.standard_normal((views, 3))
    rolls = [pose(rotation_about(UP, float(angle)), np.zeros(3)) for angle in roll]  # about the optical axis, z
    return np.stack([orbit_pose(aim[n], inclination[n], yaw[n], distance[n]) @ rolls[n] for n in range(views)])


def _within(interval: tuple[float, float], share: Array) -> Array:
    """Values at shares of an interval; shares are clipped to [0, 1]."""
    low, high = interval
    return low + (high - low) * np.clip(share, 0.0, 1.0)


def _climb(time: Array, turns: int) -> Array:
    """0.5 on the first turn, 1.5 on the second, ..., rising smoothly in the last third of each but the last."""
    at = time * turns
    turn = np.minimum(np.floor(at), turns - 1)
    late = np.clip(3.0 * (at - turn) - 2.0, 0.0, 1.0)
    rise = late * late * (3.0 - 2.0 * late)
    return turn + 0.5 + np.where(turn < turns - 1, rise, 0.0)


def _sway(time: Array, rng: np.random.Generator) -> Array:
    """Within [-1, 1]: a smooth swaying and a little irregular jitter."""
    cycles, phase = rng.uniform(1.0, 5.0, 3), rng.uniform(0.0, 2.0 * math.pi, 3)
    smooth = np.sin(2.0 * math.pi * cycles * time[:, None] + phase).mean(axis=1)
    return (1.0 - JITTER) * smooth + JITTER * rng.uniform(-1.0, 1.0, len(time))


def _normal_sway(time: Array, rng: np.random.Generator) -> Array:
    """Standard normal at each moment; neighbours are alike, because a hand turns back slowly."""
    keep = 0.7
    drawn = rng.standard_normal(len(time))
    value = np.empty(len(time))
    for n in range(len(time)):
        value[n] = drawn[n] if n == 0 else keep * value[n - 1] + math.sqrt(1.0 - keep * keep) * drawn[n]
    return value
