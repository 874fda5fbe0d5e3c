"""One photograph of a virtual capture: object and board as geometry, the Azure Kinect's two cameras, its images as stored."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.capture import CapturedView, DepthCamera
from schemas.job.captures import Board, RegistrationError, Simulate
from schemas.job.views import Render
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import (
    REGION_FIRST_OBJECT,
    REGION_FLOOR,
    REGION_TABLE,
    Appearance,
    Asset,
    Material,
    Part,
    Shape,
)
from schemas.scene.view import Camera, Intrinsics
from workers.assets.appearance import draw_appearance
from workers.capture.board import TOUCHING_M, board_geometry, marker_cells, marker_corners
from workers.capture.simulate.camera import (
    AT_REST,
    CENTRE,
    STEP_M,
    Band,
    Sample,
    add_bent_light,
    add_light,
    bands_of,
    cover_markers,
    develop,
    draw_motion,
    kinect_noise,
    make_samples,
    pinhole_lookup,
    pose_at,
)
from workers.geometry.colour import SRGB_STEPS
from workers.geometry.frames import UP, pose, rotation_about, translation
from workers.geometry.pixels import opencv_lens
from workers.geometry.zbuffer import register_depth
from workers.render.pathtraced import draw_view
from workers.render.raster.gbuffer import shared_renderer
from workers.scene.chance import SceneChance, Stream
from workers.scene.sensor import add_noise, expose, sense_depth


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
    across, up, ink = _cells(board)
    vertices, top = _grid(across, up)
    quads, black = top.reshape(-1, 4), ink.ravel()
    sides, low = _sides(vertices, len(across), len(up))
    paper = np.concatenate([quads[~black], sides])
    all_vertices = frozen_array(np.concatenate([vertices, low]))
    return Shape(
        (
            Part("paper", all_vertices, _triangles(paper), Material(PAPER, roughness=1.0)),
            Part("ink", all_vertices, _triangles(quads[black]), Material(INK, roughness=1.0)),
        ),
        closed=True,
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
    return Shape(
        (
            Part("paper", frozen_array(solid.reshape(-1, 3)), _triangles(numbers[0]), Material(PAPER, roughness=1.0)),
            Part("ink", frozen_array(quads.reshape(-1, 3)), _triangles(numbers[1]), Material(INK, roughness=1.0)),
        )
    )


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
    left, right = corners[0, :, 0, 0], corners[0, :, 1, 0]
    top, bottom = corners[:, 0, 0, 1], corners[:, 0, 3, 1]
    half = 0.5 * board.scale * np.array([board.width_m, board.height_m])
    x = (left[:, None] * (1.0 - edges) + right[:, None] * edges).ravel()
    y = (top[:, None] * (1.0 - edges) + bottom[:, None] * edges).ravel()
    across, up = np.unique([-half[0], *x, half[0]]), np.unique([-half[1], *y, half[1]])
    ink = np.zeros((len(up) - 1, len(across) - 1), np.bool_)
    for row in range(board.rows):
        for column in range(board.columns):
            i = int(np.searchsorted(up, y[row * (side + 1) + side]))
            j = int(np.searchsorted(across, x[column * (side + 1)]))
            ink[i : i + side, j : j + side] = bits[row * board.columns + column][::-1]
    return across, up, ink


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


@dataclass(frozen=True, eq=False)
class Rig:
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


DEPTH_UNITS_PER_M = 1000.0

LABELS = EffectPlan(("floor", "table"), {})
"""What is drawn of depth and regions, without colour."""

LABELS_FINER = 3
"""Regions that a lens bends are drawn so many times as fine."""

TRACED_SAMPLES_MOVING = 4
"""Paths through each pixel of the nine pictures of a moving camera, which together have 36."""

FINER = 3.0
"""The floor's pattern is so many times as fine as in a scene: a table top is looked at from nearby."""


@dataclass(frozen=True, eq=False)
class Studio:
    """What is photographed and by what; the board lies on the floor of the world, z up.

    `simulate` has the effects that run, and `effects` is the plan of drawing. T_world_board [4, 4]: the board frame lies on top
    of the board. `drawn_color` is the pinhole camera that the colour image
    is drawn with: `rig.color`, or a wider one that `lookup` bends into it.
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


def build_studio(simulate: Simulate, board: Board, thing: Placed, effects: EffectPlan, chance: SceneChance) -> Studio:
    """The floor, the board on it, and `thing`, posed in the board frame, in their light. Raises CaptureError for the lens."""
    floor, appearance = draw_appearance(chance.stream(Stream.APPEARANCE), "raster")
    parts = (part if part.uv is None else replace(part, uv=frozen_array(FINER * part.uv)) for part in floor.parts)
    T_world_board = frozen_array(translation(0.0, 0.0, THICKNESS_M))
    printed, rig = true_board(board, simulate), make_rig(simulate.image_scale)
    things = [
        Placed(REGION_FLOOR, replace(floor, parts=tuple(parts)), frozen_array(np.eye(4))),
        Placed(REGION_TABLE, board_body(printed), T_world_board),
        replace(thing, T_world_shape=frozen_array(T_world_board @ thing.T_world_shape)),
    ]
    if simulate.hidden_markers is not None:
        slips = cover_markers(simulate.hidden_markers, printed, chance.stream(Stream.HIDDEN_MARKERS))
        things[2:2] = [] if slips is None else [Placed(REGION_TABLE, slips, T_world_board)]
    drawn, lookup = rig.color, None
    if simulate.distortion is not None:
        drawn, *places = pinhole_lookup(simulate.distortion, rig.color)
        lookup = places[0], places[1]
    return Studio(simulate, effects, tuple(things), appearance, rig, T_world_board, chance, drawn, lookup)


def photograph(studio: Studio, number: int, T_board_cam: Pose) -> tuple[CapturedView, NDArray[np.bool_]]:
    """One view as it is stored, and the object's true pixels [H, W] bool."""
    T_world_cam = studio.T_world_board @ T_board_cam
    rgb = develop(sense_light(studio, number, take_light(studio, number, T_world_cam)), studio.simulate)
    depth_m = measure_depth(studio, number, T_world_cam)
    depth = np.rint(np.clip(depth_m * DEPTH_UNITS_PER_M, 0.0, 65_535.0)).astype(np.uint16)
    return CapturedView(number, rgb, depth, None), mark_object(studio, T_world_cam)


def take_light(studio: Studio, number: int, T_world_cam: Pose) -> Array:
    """[H, W, 3]: linear light of one exposure; T_world_cam is the pose at its middle, and of its middle row."""
    k, simulate = studio.rig.color, studio.simulate
    blur, rolling = (
        AT_REST if time_s is None else draw_motion(time_s, studio.chance.stream(Stream.MOTION, number))
        for time_s in (simulate.motion_blur, simulate.rolling_shutter)
    )
    samples, render = plan_pictures(studio)
    total, light_of = np.zeros((k.height, k.width, 3)), SRGB_STEPS / len(samples)
    rng = studio.chance.stream(Stream.PATHS, number)
    for place, sample in enumerate(samples):
        whole, drawn_at = (Band(0, k.height, 0.0),), point_drawn(sample, studio)
        for band in whole if rolling is AT_REST else bands_of(k.height, place, len(samples)):
            T = pose_at(pose_at(T_world_cam, rolling, band.moment), blur, sample.moment)
            rgb, rows = draw_picture(studio, drawn_at, band, T, render, rng), slice(band.first, band.stop)
            if studio.lookup is None:
                add_light(total[rows], rgb, light_of)
            else:
                (u, v), offsets = studio.lookup, (sample.right_px, sample.down_px, drawn_at.right_px, drawn_at.down_px)
                add_bent_light(total[rows], rgb, light_of, (u[rows], v[rows]), offsets)
    return total


def draw_picture(
    studio: Studio, drawn_at: Sample, band: Band, T_world_cam: Pose, render: Render, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """[h, w, 3]: a pinhole's rows of the band alone, or all of the wider picture that a lens bends."""
    k = studio.drawn_color
    # The camera whose pixel centres lie at the sample's point of each pixel.
    update = {"cx": k.cx - drawn_at.right_px, "cy": k.cy - drawn_at.down_px}
    if studio.lookup is None:
        update |= {"cy": update["cy"] - band.first, "height": band.stop - band.first}
    camera = Camera(k.model_copy(update=update), T_world_cam)
    drawn = draw_view(shared_renderer(), studio.things, studio.appearance, camera, render, lambda: rng, studio.effects)
    assert drawn.rgb is not None
    return drawn.rgb


def mark_object(studio: Studio, T_world_cam: Pose) -> NDArray[np.bool_]:
    """[H, W] bool: pixels of the stored image whose centres see the object; through a lens to a sixth of a pixel."""
    if studio.lookup is None:
        return draw_labels(studio, Camera(studio.drawn_color, T_world_cam))[1]
    _, mask = draw_labels(studio, Camera(scale_intrinsics(studio.drawn_color, LABELS_FINER), T_world_cam))
    columns, rows = (np.floor(LABELS_FINER * place).astype(np.int64) for place in studio.lookup)
    return mask[rows, columns]


def draw_labels(studio: Studio, camera: Camera) -> tuple[Array, NDArray[np.bool_]]:
    """(depth [H, W] float64, metres, 0 where nothing is; the object's pixels [H, W] bool), both of pixel centres."""
    drawn = shared_renderer().draw(studio.things, studio.appearance, camera, effects=LABELS)
    return drawn.depth_m.astype(np.float64), drawn.region == REGION_FIRST_OBJECT


def plan_pictures(studio: Studio) -> tuple[tuple[Sample, ...], Render]:
    """The samples of a photograph, and how each picture is drawn."""
    render = Render(tier=studio.simulate.tier)
    if render.tier != "pathtraced":
        return make_samples(), render
    if studio.simulate.motion_blur is None and studio.simulate.rolling_shutter is None:
        return (CENTRE,), render
    return make_samples(), render.model_copy(update={"path_samples": TRACED_SAMPLES_MOVING})


def point_drawn(sample: Sample, studio: Studio) -> Sample:
    """The point of a pixel that a picture has at its pixel centres.

    Through a lens it is the opposite one, so that the nine pictures are read at nine places between their pixels, and all of
    the image is equally sharp. A traced picture is antialiased already, with its mean at the centre.
    """
    if studio.simulate.tier == "pathtraced":
        return replace(CENTRE, moment=sample.moment)
    bent = studio.lookup is not None
    return replace(sample, right_px=-sample.right_px, down_px=-sample.down_px) if bent else sample


def sense_light(studio: Studio, number: int, light: Array) -> Array:
    """[H, W, 3]: what the colour sensor makes of linear light: exposure, then noise."""
    simulate, sensed = studio.simulate, light
    if simulate.exposure is not None:
        sensed = expose(sensed, simulate.exposure, studio.chance.sensor_stream("exposure", number))
    if simulate.rgb_noise is not None:
        sensed = add_noise(sensed, simulate.rgb_noise, studio.chance.sensor_stream("rgb_noise", number))
    return sensed


def measure_depth(studio: Studio, number: int, T_world_cam: Pose) -> Array:
    """[H, W] float64, metres: measured from the depth camera's place, and registered to the colour camera as stored."""
    simulate, device = studio.simulate, studio.rig.depth
    camera = Camera(device.intrinsics, T_world_cam @ device.T_color_depth)
    drawn = shared_renderer().draw(studio.things, studio.appearance, camera, effects=LABELS)
    depth_m: Array = drawn.depth_m.astype(np.float64)
    if simulate.depth_noise is not None:
        rng = studio.chance.sensor_stream("depth_noise", number)
        depth_m = sense_depth(depth_m, drawn.region, camera, kinect_noise(simulate.depth_noise), rng)
        depth_m = STEP_M * np.rint(depth_m / STEP_M)
    assumed = assumed_device(device, simulate.registration_error)
    return register_depth(depth_m, assumed, studio.rig.color, opencv_lens(simulate.distortion))
