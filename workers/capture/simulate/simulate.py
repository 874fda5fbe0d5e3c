"""A virtual capture from its settings to its folder: photographs with the effects of a real camera, held-out views, truth.

**Published.** Microsoft bounds the random error of depth by 17 mm and the systematic error by 11 mm + 0.1 % of the distance
over the whole range of the mode NFOV unbinned, 0.5 to 3.86 m. Tolgyessy et al. 2021 (Sensors 21(2):413) confirm both bounds
up to 3.5 m, find the noise lowest near the middle of the image and at short range, and describe pixels that fly between
a surface and what is behind it. Kurillo et al. 2022 (Sensors 22(7):2469) see the random error grow with the distance.

**Assumed.** The numbers of depth below are no fit of a published table. They are a device of the usual kind at arm's length,
far inside those bounds; what scenes have (schemas/job/views.py) is the upper bound.
"""

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.capture import CaptureCamera, CapturedView, CaptureTruth
from schemas.errors import CaptureError
from schemas.job.captures import Board, KinectDepthNoise, Simulate
from schemas.job.views import DepthNoise, Render
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import REGION_FIRST_OBJECT, Asset
from schemas.scene.view import Camera
from workers.assets.look.surroundings import require_camera_inside
from workers.capture.folder import (
    CaptureFile,
    stored_depth,
    write_description,
    write_pose,
    write_view,
)
from workers.capture.simulate.studio import (
    Around,
    Studio,
    assumed_device,
    build_studio,
    place_object,
    plan_path,
    scale_intrinsics,
)
from workers.capture.truth import HELD_OUT, TRUTH, write_true_mask, write_truth
from workers.geometry.colour import SRGB_STEPS, encode_codes, encode_srgb
from workers.geometry.frames import pose, rotation_about
from workers.geometry.jit import compiled
from workers.geometry.pixels import opencv_lens
from workers.geometry.zbuffer import register_depth
from workers.render.pathtraced import draw_view
from workers.render.raster.gbuffer import shared_renderer
from workers.scene.chance import SceneChance, Stream
from workers.scene.effects import CAPTURE_EFFECTS
from workers.scene.sensor import add_noise, expose, sense_depth

SAMPLES = 9
"""Images that are averaged into one photograph."""

DOWN, WHEN = (7, 0, 5, 2, 4, 6, 3, 8, 1), (6, 3, 0, 7, 4, 1, 8, 5, 2)
"""Row and moment of each sample, whose column is its number. No two of column, row and moment are correlated; samples n and
8 - n lie opposite one another; and of all such orders none spreads the points farther apart."""


class Sample(NamedTuple):
    """One image of the average: a point in the pixel, from its centre, and a moment of the exposure in [-0.5, 0.5]."""

    right_px: float
    down_px: float
    moment: float


CENTRE = Sample(0.0, 0.0, 0.0)
"""The sample of a picture that is antialiased already."""


def make_samples() -> tuple[Sample, ...]:
    """Nine samples with nine columns, nine rows and nine moments: an edge along a row or a column moves in steps of 1/9 px.

    Their mean is the pixel's centre at the exposure's middle, which is sample 4.
    """
    step, middle = 1.0 / SAMPLES, (SAMPLES - 1) / 2
    places = zip(range(SAMPLES), DOWN, WHEN, strict=True)
    return tuple(Sample(*((at - middle) * step for at in place)) for place in places)


class Motion(NamedTuple):
    """Even motion in the camera's own axes: `way` [3] metres and a rotation by `turn_rad` about `axis` [3] in one exposure."""

    way: Array
    axis: Array
    turn_rad: float


SHARPEN_PX = 1.0
"""Standard deviation of the blur of the unsharp mask, as cameras have it."""

HAND_M_S, HAND_DEG_S = 0.15, 8.0
"""How fast a hand moves and turns a camera that it holds still."""

AT_REST = Motion(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0)


def draw_motion(time_s: float, rng: np.random.Generator) -> Motion:
    """A motion of the hand in its exposure or readout, in a uniform direction and about a uniform axis."""
    direction, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    return Motion(HAND_M_S * time_s * direction, axis, math.radians(HAND_DEG_S) * time_s)


def pose_at(T_world_cam: Pose, motion: Motion, moment: float) -> Pose:
    """[4, 4]: the camera's pose at a moment, -0.5 to 0.5, of the exposure; T_world_cam is that of its middle."""
    return T_world_cam @ pose(rotation_about(motion.axis, moment * motion.turn_rad), moment * motion.way)


BANDS = 16
"""Bands of rows that are drawn from one pose each, where the camera moves while its rows are read."""


class Band(NamedTuple):
    """Rows [first, stop) and the moment of their middle, in [-0.5, 0.5] of the readout."""

    first: int
    stop: int
    moment: float


def bands_of(height: int, number: int, samples: int) -> tuple[Band, ...]:
    """The bands of one of so many samples: each has other bounds, so that the mean moment of a row is right to 1/18 of a band."""
    bounds = (np.arange(BANDS + 2) - (number + 0.5) / samples) / BANDS
    rows = np.unique(np.clip(np.rint(height * bounds), 0, height).astype(int)).tolist()
    return tuple(Band(a, b, (a + b) / (2 * height) - 0.5) for a, b in itertools.pairwise(rows))


def develop(light: Array, simulate: Simulate) -> NDArray[np.uint8]:
    """[H, W, 3] as the camera stores linear light [H, W, 3]: tone curve, then sharpening, then JPEG; sRGB without any."""
    tone, sharpen, jpeg = simulate.tone_curve, simulate.sharpen, simulate.jpeg
    codes = encode_codes(light)
    if tone is not None or sharpen is not None:
        value = np.clip(light, 0.0, 1.0) if tone is not None and tone.linear else encode_srgb(light)
        if tone is not None:
            value = value - tone.contrast * np.sin(2 * math.pi * value) / (2 * math.pi)
        if sharpen is not None:
            value = value + sharpen * (value - cv2.GaussianBlur(value, (0, 0), SHARPEN_PX))
        codes = np.rint(255 * np.clip(value, 0.0, 1.0)).astype(np.uint8)
    if jpeg is not None:
        _, data = cv2.imencode(".jpg", np.ascontiguousarray(codes[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, jpeg])
        codes = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)
    return codes


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


@compiled
def add_bent_light(
    total: Array,
    rgb: NDArray[np.uint8],
    light_of: Array,
    lookup: tuple[Array, Array],
    offsets: tuple[float, float, float, float],
) -> None:
    """Adds linear light of a pinhole picture rgb [h, w, 3] seen through the lens to total [H, W, 3], in place.

    `lookup` is (u, v) of each stored pixel's centre. offsets: (right, down) of the sample from there in the stored image, by
    which the place moves with the lookup's slope, and (right, down) of the point that the picture has at its pixel centres.
    """
    u, v = lookup
    right, down, drawn_right, drawn_down = offsets
    height, width = total.shape[:2]
    for row in range(height):
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        for column in range(width):
            before, after = max(column - 1, 0), min(column + 1, width - 1)
            along, across = right / max(after - before, 1), down / max(below - above, 1)
            x = u[row, column] - drawn_right - 0.5
            x += along * (u[row, after] - u[row, before]) + across * (u[below, column] - u[above, column])
            y = v[row, column] - drawn_down - 0.5
            y += along * (v[row, after] - v[row, before]) + across * (v[below, column] - v[above, column])
            i, j = int(y), int(x)
            a, b = x - j, y - i
            for channel in range(3):
                p, q = light_of[rgb[i, j, channel]], light_of[rgb[i, j + 1, channel]]
                r, s = light_of[rgb[i + 1, j, channel]], light_of[rgb[i + 1, j + 1, channel]]
                upper, lower = p + a * (q - p), r + a * (s - r)
                total[row, column, channel] += upper + b * (lower - upper)


DEPTH_UNITS_PER_M = 1000.0

LABELS = EffectPlan(("floor", "table"), {})
"""What is drawn of depth and regions, without colour."""

LABELS_FINER = 3
"""Regions that a lens bends are drawn so many times as fine."""

TRACED_SAMPLES_MOVING = 4
"""Paths through each pixel of the nine pictures of a moving camera, which together have 36."""


def photograph(studio: Studio, number: int, T_board_cam: Pose) -> tuple[CapturedView, NDArray[np.bool_]]:
    """One view as it is stored, and the object's true pixels [H, W] bool."""
    T_world_cam, simulate, chance = studio.T_world_board @ T_board_cam, studio.simulate, studio.chance
    light = take_light(studio, number, T_world_cam)
    if simulate.exposure is not None:
        light = expose(light, simulate.exposure, chance.sensor_stream("exposure", number))
    if simulate.rgb_noise is not None:
        light = add_noise(light, simulate.rgb_noise, chance.sensor_stream("rgb_noise", number))
    depth = stored_depth(measure_depth(studio, number, T_world_cam), DEPTH_UNITS_PER_M)
    return CapturedView(number, develop(light, simulate), depth, None), mark_object(studio, T_world_cam)


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
                total[rows] += cv2.LUT(rgb, light_of)
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
        return draw_labels(studio, Camera(studio.drawn_color, T_world_cam))[1] == REGION_FIRST_OBJECT
    finer = Camera(scale_intrinsics(studio.drawn_color, LABELS_FINER), T_world_cam)
    columns, rows = (np.floor(LABELS_FINER * place).astype(np.int64) for place in studio.lookup)
    return draw_labels(studio, finer)[1][rows, columns] == REGION_FIRST_OBJECT


def draw_labels(studio: Studio, camera: Camera) -> tuple[Array, NDArray[np.uint8]]:
    """(depth [H, W] float64, metres, 0 where nothing is; regions [H, W]), both of pixel centres."""
    drawn = shared_renderer().draw(studio.things, studio.appearance, camera, effects=LABELS)
    return drawn.depth_m.astype(np.float64), drawn.region


def plan_pictures(studio: Studio) -> tuple[tuple[Sample, ...], Render]:
    """The samples of a photograph, and how each picture is drawn."""
    render, simulate = Render(tier=studio.simulate.tier), studio.simulate
    if render.tier != "pathtraced":
        return make_samples(), render
    if simulate.motion_blur is None and simulate.rolling_shutter is None:
        return (CENTRE,), render
    return make_samples(), render.model_copy(update={"path_samples": TRACED_SAMPLES_MOVING})


def point_drawn(sample: Sample, studio: Studio) -> Sample:
    """The point of a pixel that a picture has at its pixel centres.

    Through a lens it is the opposite one, so that the nine pictures are read at nine places between their pixels, and all of
    the image is equally sharp. A traced picture is antialiased already, with its mean at the centre.
    """
    if studio.simulate.tier == "pathtraced":
        return CENTRE._replace(moment=sample.moment)
    if studio.lookup is None:
        return sample
    return Sample(-sample.right_px, -sample.down_px, sample.moment)


def measure_depth(studio: Studio, number: int, T_world_cam: Pose) -> Array:
    """[H, W] float64, metres: measured from the depth camera's place, and registered to the colour camera as stored."""
    simulate, device = studio.simulate, studio.rig.depth
    camera = Camera(device.intrinsics, T_world_cam @ device.T_color_depth)
    depth_m, region = draw_labels(studio, camera)
    if simulate.depth_noise is not None:
        rng = studio.chance.sensor_stream("depth_noise", number)
        depth_m = sense_depth(depth_m, region, camera, kinect_noise(simulate.depth_noise), rng)
        depth_m = STEP_M * np.rint(depth_m / STEP_M)
    assumed = assumed_device(device, simulate.registration_error)
    return register_depth(depth_m, assumed, studio.rig.color, opencv_lens(simulate.distortion))


VIEWS = 3

HELD_OUT_UNITS_PER_M = 10_000.0
"""Finer than a capture's, so that rounding is no part of an error: 0.1 mm, up to 6.5 m."""


def write_held_out(studio: Studio, board: Board, poses: Array, path: Path) -> None:
    """Write exact views from `poses` [V, 4, 4], board frame, to `path`, a new folder of the same layout as a capture.

    The poses stand in board_00000.txt. They are pictures of the same things without the effects of any sensor or lens: depth
    and mask are those of the pixel centres.
    """
    path.mkdir(parents=True)
    ideal = studio.simulate.model_copy(update=dict.fromkeys(CAPTURE_EFFECTS))
    exact = replace(studio, simulate=ideal, drawn_color=studio.rig.color, lookup=None)
    for number, T_board_cam in enumerate(poses):
        T_world_cam = studio.T_world_board @ T_board_cam
        depth_m, region = draw_labels(exact, Camera(studio.rig.color, T_world_cam))
        depth = stored_depth(depth_m, HELD_OUT_UNITS_PER_M)
        rgb = encode_codes(take_light(exact, number, T_world_cam))
        write_view(path, CapturedView(number, rgb, depth, region == REGION_FIRST_OBJECT))
        write_pose(path / f"board_{number:05d}.txt", T_board_cam)
    camera = CaptureCamera(studio.rig.color, opencv_lens(None), HELD_OUT_UNITS_PER_M)
    write_description(path, CaptureFile(name="held-out"), camera, board)


def simulate_capture(
    simulate: Simulate, board: Board, asset: Asset, chance: SceneChance, path: Path, around: Around | None = None
) -> CaptureTruth:
    """Photograph `asset` on the board and write the folder of a capture, with truth/, to `path`, a new or empty folder.

    `chance` decides all that is random: the same arguments write the same bytes. `around`: what stands around the board.
    camera.json comes last, so that a capture that was cut off cannot be mistaken for a whole one. Raises CaptureError where the
    folder has files or the lens cannot be, StartError and ViewError where the room is too small for the board or a camera.
    """
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise CaptureError("exists", f"{path} holds files already: name a new or an empty folder")
    thing = Placed(REGION_FIRST_OBJECT, asset.shape, place_object(asset, chance.stream(Stream.START)))
    studio = build_studio(simulate, board, thing, chance, around)
    target = thing.T_world_shape[:3, 3]
    poses = plan_path(simulate, target, chance.stream(Stream.CAMERA))
    few = simulate.model_copy(update={"views": VIEWS})
    held_out = plan_path(few, target, chance.stream(Stream.HELD_OUT))
    for T_board_cam in (*poses, *held_out):  # before anything is written
        require_camera_inside(studio.walls, "capture's", Camera(studio.rig.color, studio.T_world_board @ T_board_cam))
    for number, T_board_cam in enumerate(poses):
        view, mask = photograph(studio, number, T_board_cam)
        write_view(path, view)
        write_true_mask(path, number, mask)
    truth = CaptureTruth(
        T_board_cam=frozen_array(poses),
        T_board_obj=thing.T_world_shape,
        print_scale=1.0 if simulate.print_scale is None else simulate.print_scale,
        T_color_depth=studio.rig.depth.T_color_depth,
        depth_bias_m=0.0 if simulate.depth_noise is None else simulate.depth_noise.bias_m,
        lens=simulate.distortion,
    )
    write_held_out(studio, board, held_out, path / TRUTH / HELD_OUT)
    write_truth(path, truth, asset, studio.effects, studio.surroundings)
    about = CaptureFile(name=f"{asset.category}-{chance.scene_id:05d}", category=asset.category, licence=asset.licence)
    camera = CaptureCamera(studio.rig.color, opencv_lens(simulate.distortion), DEPTH_UNITS_PER_M)
    write_description(path, about, camera, board)
    return truth
