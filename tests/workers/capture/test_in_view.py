"""What photographs show beside an object on the board of board.json: another board, a second print, a hand; simulated."""

import re
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from schemas.base import frozen_array
from schemas.capture import CaptureCamera
from schemas.errors import CaptureError
from schemas.job.captures import Board, Captures, Estimation, Simulate
from schemas.scene.scene import Placed
from schemas.scene.shape import REGION_TABLE, Material, Part, Shape
from services.cli.main import main
from tests.conftest import SHARED_DATA
from tests.kit.tiers import first_of
from tests.workers.capture.drawn import errors
from tests.workers.capture.simulated import studio_of
from workers.capture.board_kinds import KINDS, BoardSizes
from workers.capture.folder import CaptureFile, open_folder, read_view, write_description, write_view
from workers.capture.process import process_folder, read_result
from workers.capture.simulate.simulate import mark_object, photograph
from workers.capture.simulate.studio import board_body
from workers.geometry.camera import look_at
from workers.geometry.frames import UP, pose, rotation_about, transform


def with_things(studio, things):
    """The studio with more in it, posed in the board frame."""
    posed = (replace(thing, T_world_shape=studio.T_world_board @ thing.T_world_shape) for thing in things)
    return replace(studio, things=(*studio.things, *posed))


def photographed(path, board, given=None, views=3, beside=lambda number: (), more=(), **effects):
    """The true poses of photographs of a can on a board, which board.json gives as `given`; `beside`: what else each shows.

    `more`: further poses.
    """
    studio, _, poses = studio_of(Simulate(views=views, image_scale=0.5, **effects), board)
    poses = [*poses, *more]
    path.mkdir(parents=True, exist_ok=True)
    for number, T in enumerate(poses):
        write_view(path, photograph(with_things(studio, beside(number)), number, T)[0])
    write_description(path, CaptureFile(name="x"), CaptureCamera(studio.rig.color, np.zeros(8)), given or board)
    return poses


# ---------------------------------------------------------------------------------------------- another board


def made(kind, size, dictionary="DICT_4X4_100", marker_m=0.045, pitch_m=0.06):
    return KINDS[kind](BoardSizes(*size, marker_m, pitch_m, dictionary))


GRID = made("grid", (9, 6))
OTHERS = {
    "grid, and photographs of ChArUco": (GRID, ("charuco", (9, 6))),
    "ChArUco, and photographs of a grid": (made("charuco", (9, 6)), ("grid", (9, 6))),
    "ChArUco of another pattern": (made("charuco", (10, 6)), ("charuco_old", (10, 6))),
    "another dictionary": (GRID, ("charuco", (9, 6), "DICT_5X5_50")),
    "grid, and photographs of an aprilgrid": (
        made("grid", (6, 4), "DICT_4X4_100", 0.06, 0.078),
        ("aprilgrid", (6, 4), "DICT_APRILTAG_36h11", 0.06, 0.078),
    ),
    "other numbers": (GRID, ("grid", (8, 7))),
    "other numbers of squares": (made("charuco", (9, 6)), ("charuco", (8, 7))),
}


@pytest.mark.parametrize("name", first_of(OTHERS, 0, 3))
def test_a_board_that_is_not_board_jsons_is_named_and_the_command_that_is_printed_makes_the_capture_right(
    name, tmp_path
):
    given, true = OTHERS[name]
    poses = photographed(tmp_path, made(*true), given)
    with pytest.raises(CaptureError) as refused:
        process_folder(tmp_path, Captures())
    command = re.search(r"move it away, and `\S*verso (capture board [^`]+)`", str(refused.value))
    assert command and "--kind " + true[0] in command[1] and "{}x{}".format(*true[1]) in command[1]
    assert "mirrored" not in str(refused.value) and "blurred" not in str(refused.value)
    (tmp_path / "board.json").unlink()
    assert main(shlex.split(command[1])) == 0
    used = process_folder(tmp_path, Captures()).estimates.estimate.used
    assert len(used) == len(poses) and max(errors(v.T_board_cam, poses[v.number])[0] for v in used) < 1.0


# ---------------------------------------------------------------------------------------------- a second print


def print_of(board, place_m, turn_deg=0.0, tilt_deg=0.0, size=1.0):
    """A print of the board, `size` times as large, that lies or stands elsewhere."""
    body = board_body(board.model_copy(update={"measured_ruler_m": size * board.ruler_m}))
    R = rotation_about(UP, np.radians(turn_deg)) @ rotation_about(np.array([1.0, 0, 0]), np.radians(tilt_deg))
    return Placed(REGION_TABLE, body, pose(R, np.array(place_m)))


BESIDE = print_of(Board(), (0.5, 0.12, -0.003), 35)
SECONDS = {
    "beside the board": lambda n: [BESIDE],
    "in some views, moved between two": lambda n: [[], [BESIDE], [print_of(Board(), (-0.3, 0.45, 0.0), 80)]][n % 3],
    "half below the board": lambda n: [print_of(Board(), (0.4, 0.0, -0.004), 0)],
    "larger": lambda n: [print_of(Board(), (0.2, 0.62, -0.003), 10, 0, 1.41)],
    "on a screen that stands": lambda n: [print_of(Board(), (0.0, 0.4, 0.12), 0, 70, 0.5)],
    "turned by half a turn": lambda n: [print_of(Board(), (0.0, 0.45, 0.0), 180)],
}


@pytest.mark.parametrize("name", first_of(SECONDS, 0, 2))
def test_of_two_prints_in_view_the_one_that_the_object_stands_on_is_the_board(name, tmp_path):
    poses = photographed(tmp_path, Board(), views=6, beside=SECONDS[name])
    made = process_folder(tmp_path, Captures(estimation=Estimation(compare=True)))
    for estimate in (made.estimates.estimate, made.estimates.by_name["markers"]):
        off = [errors(v.T_board_cam, poses[v.number])[0] for v in estimate.used]
        assert len(off) == len(poses) and max(off) < 0.3
    assert "a second print of the board is in view" in made.estimates.estimate.notes[0]


@pytest.mark.minute
def test_a_view_of_the_second_print_alone_has_no_pose(tmp_path):
    aside = look_at(np.array([0.75, 0.3, 0.25]), np.array([0.68, 0.28, 0.0]))
    poses = photographed(tmp_path, Board(), views=3, beside=lambda n: [BESIDE], more=[aside])
    made = process_folder(tmp_path, Captures(estimation=Estimation(compare=True)))
    for estimate in (made.estimates.estimate, made.estimates.by_name["markers"]):
        assert [v.number for v in estimate.used] == [0, 1, 2]
        assert max(errors(v.T_board_cam, poses[v.number])[0] for v in estimate.used) < 0.3
        assert estimate.views[3].markers > 10 and "nothing stands on the one it shows" in estimate.views[3].reasons[0]


# ---------------------------------------------------------------------------------------------- a hand


def arm(turn_rad, tip_m, radius_m=0.025):
    """A forearm with a fist at a place, board frame, that comes from outside of the board and from above."""
    start = 0.55 * np.array([np.cos(turn_rad), np.sin(turn_rad), 0.5])
    forearm = trimesh.creation.cylinder(radius_m, segment=[start, tip_m])
    mesh = trimesh.util.concatenate([forearm, trimesh.creation.icosphere(2, 1.6 * radius_m).apply_translation(tip_m)])
    part = Part("arm", frozen_array(mesh.vertices), frozen_array(mesh.faces, np.int32), Material((0.8, 0.6, 0.5, 1.0)))
    return Placed(REGION_TABLE, Shape((part,)), np.eye(4))


EDGE = (0.4, (0.2, 0.1, 0.05))
HANDS = {
    "over the edge, elsewhere each time": {1: [EDGE], 4: [(2.5, (-0.19, 0.1, 0.06))], 6: [(-1.5, (0.03, -0.17, 0.05))]},
    "between camera and object": {n: [(0.4, (0.1, 0.02, 0.12))] for n in (0, 3)},
    "twice in one place": {2: [EDGE], 3: [EDGE]},
    "two about the object": {5: [(0.2, (0.11, 0.0, 0.06)), (3.3, (-0.11, 0.0, 0.06))]},
}


@pytest.mark.parametrize("name", first_of(HANDS, 0, 2))
def test_a_hand_over_the_board_is_no_object_that_moved_and_in_no_cloud_or_mask(name, tmp_path):
    def beside(n):
        return [arm(*one) for one in HANDS[name].get(n, ())]

    shifted = {"registration_error": {}} if name == "between camera and object" else {}  # depth hides other pixels
    poses = photographed(tmp_path, Board(), views=8, beside=beside, **shifted)
    made = process_folder(tmp_path, Captures())
    estimate, points = made.estimates.estimate, made.merged.surface.points
    off = [errors(v.T_board_cam, poses[v.number])[0] for v in estimate.used]
    assert len(off) == len(poses) and max(off) < 0.4 and not any("moved" in note for note in estimate.notes)
    cluttered = {view.number for view in estimate.views if view.is_cluttered}
    assert (
        cluttered and cluttered <= set(HANDS[name]) and any("alone has on the board" in note for note in estimate.notes)
    )
    studio, can, _ = studio_of(Simulate(views=8, image_scale=0.5))
    mesh = trimesh.Trimesh(transform(can.T_world_shape, can.shape.vertices), can.shape.faces)
    true = mesh.sample(50_000, seed=0)
    assert (
        cKDTree(true).query(points)[0].max() < 0.006
        and cKDTree(points).query(true)[0][true[:, 2] > 0.01].mean() < 0.003
    )
    for n in HANDS[name]:
        seen = mark_object(with_things(studio, beside(n)), studio.T_world_board @ poses[n])
        mask = read_view(open_folder(tmp_path), n).mask
        again = read_result(tmp_path).images(n).mask
        assert (mask & seen).sum() > 0.96 * (mask | seen).sum() and (again != mask).sum() < 0.001 * mask.sum()


# ---------------------------------------------------------------------------------------------- by a ray caster not ours


@pytest.mark.minute
@pytest.mark.shared_data
@pytest.mark.parametrize("name", ["hand", "spare_board"])
def test_all_views_of_an_independent_capture_are_used_whatever_lies_beside_the_object(name, tmp_path):
    captures = SHARED_DATA / "captures"
    if name == "spare_board":  # it holds the views that differ
        shutil.copytree(captures / "m_ref", tmp_path, dirs_exist_ok=True)
    shutil.copytree(captures / "turn4" / name, tmp_path, dirs_exist_ok=True)
    truth = np.load(captures / "mug.truth.npy" if name == "spare_board" else tmp_path / "truth.npy")
    estimates = process_folder(tmp_path, Captures(estimation=Estimation(compare=True))).estimates
    for estimate, most_mm in (("joint", 0.06), ("markers", 0.8)):  # one view alone does not know what sharpening does
        off = [errors(v.T_board_cam, truth[v.number])[0] for v in estimates.by_name[estimate].used]
        assert len(off) == {"hand": 11, "spare_board": 10}[name] and max(off) < most_mm
