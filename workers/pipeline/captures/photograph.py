"""One photograph of a virtual capture: both cameras' images as the device stores them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.capture.view import CapturedView
from schemas.job.captures import Board, Simulate
from schemas.job.render import Render
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Camera, Intrinsics
from schemas.scene.effects import EffectPlan
from schemas.scene.region import REGION_FIRST_OBJECT, REGION_FLOOR, REGION_TABLE
from schemas.scene.scene import Placed
from schemas.scene.shape import Part, Shape
from workers.assets.appearance import draw_appearance
from workers.capture.simulate.board_body import THICKNESS_M, board_body
from workers.capture.simulate.cover import cover_markers
from workers.capture.simulate.lens import add_bent_light, nearest_pixels, opencv_lens, pinhole_lookup
from workers.capture.simulate.motion import AT_REST, Motion, draw_motion, pose_at
from workers.capture.simulate.noise import STEP_M, kinect_noise
from workers.capture.simulate.place import true_board
from workers.capture.simulate.rig import Rig, assumed_device, make_rig, scale_intrinsics
from workers.capture.simulate.sampling import CENTRE, Sample, add_light, light_table, make_samples, shift_camera
from workers.geometry.colour import encode_codes
from workers.geometry.frames import translation
from workers.geometry.zbuffer import register_depth
from workers.plan.randomness import SceneChance, Stream
from workers.render.raster.gbuffer import shared_renderer
from workers.render.tiers import draw_view
from workers.sensor.depth import sense_depth
from workers.sensor.rgb import add_noise, expose

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
    T_world_board = frozen_array(translation(0.0, 0.0, THICKNESS_M))
    printed, rig = true_board(board, simulate), make_rig(simulate.image_scale)
    things = [
        Placed(REGION_FLOOR, _finer(floor), frozen_array(np.eye(4))),
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


def _finer(floor: Shape) -> Shape:
    """The floor with a pattern `FINER` times as fine."""

    def finer(part: Part) -> Part:
        return part if part.uv is None else replace(part, uv=frozen_array(FINER * part.uv))

    return replace(floor, parts=tuple(finer(part) for part in floor.parts))


def photograph(studio: Studio, number: int, T_board_cam: Pose) -> tuple[CapturedView, NDArray[np.bool_]]:
    """One view as it is stored, and the object's true pixels [H, W] bool."""
    T_world_cam = studio.T_world_board @ T_board_cam
    rgb = encode_codes(sense_light(studio, number, take_light(studio, number, T_world_cam)))
    depth_m = measure_depth(studio, number, T_world_cam)
    depth = np.rint(np.clip(depth_m * DEPTH_UNITS_PER_M, 0.0, 65_535.0)).astype(np.uint16)
    return CapturedView(number, rgb, depth, None), mark_object(studio, T_world_cam)


def take_light(studio: Studio, number: int, T_world_cam: Pose) -> Array:
    """[H, W, 3]: linear light of one exposure, whose middle is at the pose T_world_cam."""
    k, motion = studio.rig.color, motion_of(studio, number)
    samples, render = plan_pictures(studio)
    total, light_of = np.zeros((k.height, k.width, 3)), light_table(len(samples))
    rng = studio.chance.stream(Stream.PATHS, number)
    for sample in samples:
        drawn_at = point_drawn(sample, studio)
        camera = Camera(shift_camera(studio.drawn_color, drawn_at), pose_at(T_world_cam, motion, sample.moment))
        drawn = draw_view(
            shared_renderer(), studio.things, studio.appearance, camera, render, lambda: rng, studio.effects
        )
        assert drawn.rgb is not None
        if studio.lookup is None:
            add_light(total, drawn.rgb, light_of)
        else:
            offsets = (sample.right_px, sample.down_px, drawn_at.right_px, drawn_at.down_px)
            add_bent_light(total, drawn.rgb, light_of, studio.lookup, offsets)
    return total


def mark_object(studio: Studio, T_world_cam: Pose) -> NDArray[np.bool_]:
    """[H, W] bool: pixels of the stored image whose centres see the object; through a lens to a sixth of a pixel."""
    finer = 1 if studio.lookup is None else LABELS_FINER
    _, mask = draw_labels(studio, Camera(scale_intrinsics(studio.drawn_color, finer), T_world_cam))
    return mask if studio.lookup is None else nearest_pixels(mask, *(finer * place for place in studio.lookup))


def draw_labels(studio: Studio, camera: Camera) -> tuple[Array, NDArray[np.bool_]]:
    """(depth [H, W] float64, metres, 0 where nothing is; the object's pixels [H, W] bool), both of pixel centres."""
    drawn = shared_renderer().draw(studio.things, studio.appearance, camera, effects=LABELS)
    return drawn.depth_m.astype(np.float64), drawn.region == REGION_FIRST_OBJECT


def motion_of(studio: Studio, number: int) -> Motion:
    """The camera's motion in one exposure."""
    if studio.simulate.motion_blur is None:
        return AT_REST
    return draw_motion(studio.simulate.motion_blur, studio.chance.stream(Stream.MOTION, number))


def plan_pictures(studio: Studio) -> tuple[tuple[Sample, ...], Render]:
    """The samples of a photograph, and how each picture is drawn."""
    render = Render(tier=studio.simulate.tier)
    if render.tier != "pathtraced":
        return make_samples(), render
    if studio.simulate.motion_blur is None:
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
        sensed = expose(sensed, simulate.exposure, studio.chance.stream(Stream.SENSOR_EXPOSURE, number))
    if simulate.rgb_noise is not None:
        sensed = add_noise(sensed, simulate.rgb_noise, studio.chance.stream(Stream.SENSOR_RGB, number))
    return sensed


def measure_depth(studio: Studio, number: int, T_world_cam: Pose) -> Array:
    """[H, W] float64, metres: measured from the depth camera's place, and registered to the colour camera as stored."""
    simulate, device = studio.simulate, studio.rig.depth
    camera = Camera(device.intrinsics, T_world_cam @ device.T_color_depth)
    drawn = shared_renderer().draw(studio.things, studio.appearance, camera, effects=LABELS)
    depth_m: Array = drawn.depth_m.astype(np.float64)
    if simulate.depth_noise is not None:
        rng = studio.chance.stream(Stream.SENSOR_DEPTH, number)
        depth_m = sense_depth(depth_m, drawn.region, camera, kinect_noise(simulate.depth_noise), rng)
        depth_m = STEP_M * np.rint(depth_m / STEP_M)
    assumed = assumed_device(device, simulate.registration_error)
    return register_depth(depth_m, assumed, studio.rig.color, opencv_lens(simulate.distortion))
