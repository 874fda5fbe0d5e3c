"""What the simulator is given, what it leaves behind, and the fall of a body in it, against closed forms."""

import dataclasses
import errno
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ObjectStart
from schemas.scene.shape import Mesh
from tests.hard_cases.drops import level
from tests.kit.shapes import asset_of, box
from tests.physics.room import at, ball_body, drop
from tests.physics.settling import start_at
from workers.geometry.frames import (
    pose,
    quaternion_from_rotation,
    rotation_about,
    transform,
    translation,
    uniform_rotation,
)
from workers.geometry.hull import convex_hull, depth_m
from workers.physics import bullet, rigid_body
from workers.physics.bullet import DECIMALS, GRAVITY_M_S2, STDERR, obj_of, open_world, silence_stderr
from workers.physics.fall import (
    FINEST,
    LIFT_M,
    SHARE,
    SKIPPED_TO_M,
    EnergyRecord,
    Outcome,
    StepSizes,
    Watch,
    fall,
)
from workers.physics.release import PACES, SLIDE_M, Drop, release, stays_standing
from workers.physics.rigid_body import Body, body_frame, build_body, make_body, octants

ROOT = Path(__file__).resolve().parents[3]
PHYSICS = Job(name="t").physics
STEPS = 8
GROWTH = """
import numpy as np
from schemas.job.job import Job
from schemas.scene.shape import Mesh
from workers.physics.bullet import open_world
from workers.physics.rigid_body import Body, octants

def anonymous_kb():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("RssAnon"))

points = np.random.default_rng(0).standard_normal((400, 3))
body = Body(1.0, np.ones(3) * 1e-3, (0.1 * points / np.linalg.norm(points, axis=1)[:, None],), 1e-4)
bodies = [body, Body(1.0, np.ones(3) * 1e-3, octants(body.parts[0], 0.05), 1e-4)]
square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
plate = Mesh(np.tile(square, (100, 1)), np.arange(400)[:, None] // 4 * 4 + np.array([[0, 1, 2], [0, 2, 3]]).repeat(200, 0))
T = np.eye(4)
T[2, 3] = 3.0
sizes = []
for world in range(513):
    with open_world([(bodies[world // 4 % 2], T)], plate if world % 4 == 3 else 0.0, Job(name="t").physics, 8) as falling:
        falling.advance()
    sizes.append(anonymous_kb())
print((sizes[512] - sizes[256]) / 256)
"""


def body_of(shape) -> Body:
    return Body(0.4, np.array([1.5e-3, 1.6e-3, 5e-4]), (np.asarray(shape.vertices),), 1e-4)


def test_worlds_have_the_same_bits_whatever_was_simulated_before_and_whether_they_begin_with_a_reset(monkeypatch):
    """Drops that turn, slide and roll on, some of several bodies or onto a mesh, in three orders."""
    rng = np.random.default_rng(8)
    shapes = [body_of(box(0.1, 0.08, 0.2)), body_of(box(0.02, 0.3, 0.1)), ball_body(0.03)]
    plate = Mesh(np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    drops = []
    for number in range(60):
        count, ground = (2, 0.0) if number % 15 == 7 else (1, plate) if number % 15 == 11 else (1, 0.0)
        spots = [np.array([0.05 * k, 0.0, 0.15 + 0.3 * k]) for k in range(count)]
        placed = [(shapes[(number + k) % 3], pose(uniform_rotation(rng), spot)) for k, spot in enumerate(spots)]
        drops.append((placed, ground, float(rng.uniform(200, 2000)), rng.normal(0.0, 0.3, 3)))

    def ended(placed, ground, step_hz, push):
        with open_world(placed, ground, PHYSICS, STEPS) as world:
            world.set_rate(step_hz)
            world.set_velocity(push)
            for _ in range(50):
                world.advance()
            return [(world.pose(k), world.velocity(k)) for k in range(len(placed))]

    with monkeypatch.context() as patch:
        patch.setattr(bullet, "MOST_KEPT", 0)
        expected = [ended(*one) for one in drops]
    monkeypatch.setattr(bullet, "MOST_KEPT", 20)
    for seed in range(3):
        for number in np.random.default_rng(seed).permutation(len(drops)):
            assert ended(*drops[number]) == expected[number]


def test_bodies_that_are_kept_apart_pass_through_one_another_and_those_of_the_next_world_do_not():
    body = body_of(box(0.1, 0.1, 0.1))
    for apart, height_m in (((), 0.15), (((0, 1),), 0.05), ((), 0.15)):
        poses = [at(0.0, 0.05), at(0.0, 0.16)]
        ended = fall([body, body], poses, 0.0, PHYSICS, StepSizes(960, 1e-3), 0.0, Watch(apart=apart)).poses
        assert ended[1][2, 3] == pytest.approx(height_m, abs=1e-3)


@pytest.mark.minute
def test_worlds_come_and_go_without_their_memory_staying():
    run = [sys.executable, "-c", GROWTH]
    kilobytes = float(subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()[-1])
    # 400 vertices that PyBullet does not give back are 70 kB in each world, and the plate's indices 20 more; a file of parts
    # that it keeps is 40.
    assert kilobytes < 5.0


def test_no_file_of_parts_stays_behind_also_where_the_disk_is_full(monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    body = body_of(box(0.1, 0.1, 0.1))
    body = dataclasses.replace(body, parts=octants(body.parts[0], 0.01))

    def begin():
        with drop(body, at(0.0, 1.0), 0.0, PHYSICS, STEPS) as world:
            world.advance()

    def write_half(path, data):
        path.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    begin()
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(Path, "write_bytes", write_half)
    with pytest.raises(OSError, match=r"No space left on device: .*verso-parts-"):
        begin()
    assert list(tmp_path.iterdir()) == []


def test_what_c_code_writes_is_dropped_within_the_block_alone(capfd):
    with silence_stderr():
        os.write(STDERR, b"banner")
    os.write(STDERR, b"message")
    assert capfd.readouterr().err == "message"


def test_coordinates_are_written_as_python_writes_them_with_nine_digits():
    for size_m in (1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 0.1, 1.0, 9.9, 11.0, 2e4):
        part = np.round(np.random.default_rng(0).uniform(-size_m, size_m, (500, 3)), DECIMALS)
        lines = [line for line in obj_of([part]).decode("ascii").splitlines() if line.startswith("v")]
        assert lines == ["v " + " ".join(f"{value:.9g}" for value in point) for point in part.tolist()], size_m


# ---------------------------------------------------------------------------------------------- bodies

SHAPES = {
    "box": box(0.1, 0.08, 0.2),
    "cylinder": trimesh.creation.cylinder(0.04, 0.2, sections=48),
    "cone": trimesh.creation.cone(0.05, 0.1, sections=32),
    "tilted box": box(0.1, 0.02, 0.05).apply_transform(
        pose(uniform_rotation(np.random.default_rng(5)), np.array([0.3, -0.2, 0.1]))
    ),
    "ball": trimesh.creation.icosphere(subdivisions=2, radius=0.05),
}


def test_the_octants_of_a_hull_lie_in_it_and_have_all_of_its_vertices():
    """So that the lowest point of the parts is the hull's in every direction."""
    for name, shape in SHAPES.items():
        (hull,) = make_body(start_at(asset_of(shape))).parts
        parts = octants(hull, depth_m(hull, convex_hull(hull).normals))
        assert len(parts) <= 8
        every, faces = np.concatenate(parts), convex_hull(hull).normals
        assert {tuple(point) for point in hull} <= {tuple(point) for point in every}, name
        assert ((every @ faces.T).max(axis=0) <= (hull @ faces.T).max(axis=0) + 1e-12).all(), name


def test_a_hull_or_parts_become_one_body_about_the_centre_of_mass_of_all():
    whole = start_at(asset_of(SHAPES["tilted box"]))
    made = make_body(whole)
    assert transform(made.T_obj_body, made.parts[0]) == pytest.approx(whole.hull.vertices, abs=1e-12)
    legs = [box(0.02, 0.1, 0.1, (x, 0, 0.05)) for x in (-0.09, 0.09)]
    meshes = (*legs, box(0.2, 0.1, 0.001, (0, 0, 0.1005)))
    start = start_at(asset_of(*meshes))
    made = make_body(start, parts=tuple(np.asarray(m.vertices) for m in meshes))
    for part, mesh in zip(made.parts, meshes, strict=True):
        back = transform(made.T_obj_body, part)
        assert [back.min(axis=0), back.max(axis=0)] == [pytest.approx(bound, abs=1e-12) for bound in mesh.bounds]
    far = np.linalg.norm(start.hull.vertices - start.asset.mass.com, axis=1).max()
    assert made.reach_m == pytest.approx(far)


def test_convex_parts_of_a_mesh_from_outside_are_as_fine_as_the_key_says(monkeypatch):
    asked = []
    monkeypatch.setattr(
        rigid_body, "parts_of", lambda asset, threshold, _: asked.append(threshold) or (asset.shape.vertices,)
    )
    tray = asset_of(box(0.2, 0.2, 0.05).difference(box(0.18, 0.18, 0.05).apply_translation([0, 0, 0.01])))
    for concavity in (0.1, 0.02):
        physics = PHYSICS.model_copy(update={"concavity": concavity})
        build_body(start_at(tray), physics, EffectPlan(("decomposition",), {}))
    assert asked == [0.1, 0.02]


# ---------------------------------------------------------------------------------------------- what is watched

TOP_M = 0.7
STILL = (0.0, 0.0, 0.0)


def standing(x: float, y: float, z: float, up_m: float = 0.0) -> ObjectStart:
    return start_at(asset_of(box(x, y, z)), translation(0.0, 0.0, TOP_M + z / 2 + up_m))


def stands(start: ObjectStart, v=STILL, friction: float = 0.7) -> bool:
    """On a table of which the friction is half that of the object."""
    physics = Physics(friction={"box": friction, "table": friction / 2})
    T = start.T_world_obj @ body_frame(start.asset.mass)[0]
    at = (tuple(T[:3, 3].tolist()), tuple(quaternion_from_rotation(T[:3, :3]).tolist()))
    return stays_standing(start, make_body(start), TOP_M, physics)(at, (v, STILL)) is not None


def test_what_would_slide_or_has_the_energy_to_tip_does_not_count_as_standing():
    """Friction brakes by mu g: the way is v^2 / (2 mu g). To tip, the centre of mass rises from h to the root of h^2 and the
    half width squared."""
    for friction in (0.1, 0.7):
        speed = math.sqrt(2.0 * friction**2 / 2 * GRAVITY_M_S2 * SLIDE_M)
        for share in (0.99, 1.01):
            slow = stands(standing(0.1, 0.08, 0.2), v=(share * speed, 0.0, 0.0), friction=friction)
            assert slow == (share < 1.0), (friction, share)
    assert not stands(standing(0.1, 0.08, 0.2), v=(1e-6, 0.0, 0.0), friction=0.0)
    for width in (0.01, 0.02):
        barrier_m = math.hypot(0.1, width) / 2.0 - 0.1 / 2.0
        for share in (0.99, 1.01):
            assert stands(standing(width, 0.05, 0.1, share * (barrier_m - LIFT_M))) == (share < 1.0), (width, share)


def test_a_drop_ends_sooner_where_the_object_stands_and_as_it_would_have():
    table = level()
    start = start_at(asset_of(box(0.1, 0.08, 0.2)), translation(0.0, 0.0, table.top.height_m + 0.11))
    one = Drop((start,), table, PHYSICS, EffectPlan(("dynamics", "fine_step"), {}))
    sooner, _ = release(one, True, PACES)
    later, _ = release(dataclasses.replace(one, physics=PHYSICS.model_copy(update={"exact_rest": False})), True, PACES)
    assert sooner.rested and sooner.seconds < later.seconds - PHYSICS.rest.window_s / 2
    assert sooner.poses[0][:2, 3] == pytest.approx(later.poses[0][:2, 3], abs=3e-6)


def test_a_rise_is_measured_from_the_least_so_far_and_against_all_that_was_set_free():
    body, moving = Body(2.0, np.array([1e-3, 2e-3, 4e-3]), (np.zeros((1, 3)),)), [(STILL, STILL)]
    first, *heights = [[((0.0, 0.0, height), (0.0, 0.0, 0.0, 1.0))] for height in (1.0, 0.4, 0.4004, 0.3, 0.3003, 0.0)]
    record = EnergyRecord([body], first, moving)
    for height in heights:
        record.add(height, moving)
    assert record.rise() == pytest.approx(4e-4 / (SHARE * 1.0))


def test_a_fall_ends_once_its_rise_is_sure_and_any_other_as_if_nobody_had_looked():
    """A box that lands on a corner in steps of 17 ms gains energy, whatever it may still set free down to -0.01 m."""
    T = pose(rotation_about(np.array([0.8, 0.6, 0.0]), 0.7), np.array([0.0, 0.0, 0.3]))
    body, coarse = body_of(trimesh.creation.box((0.1, 0.08, 0.2))), PHYSICS.model_copy(update={"step_hz": 60})

    def ended(most_rise: float) -> Outcome:
        watch = Watch(most_rise=most_rise, lowest_m=-0.01)
        return fall([body], [T], 0.0, coarse, StepSizes(60, math.inf), 0.0, watch)

    whole = ended(math.inf)
    assert whole.rise > 1.0 and whole.stopped_by is None
    sooner = ended(whole.rise / 2.0)
    assert sooner.stopped_by == "rise" and sooner.rise >= whole.rise / 2.0 and sooner.seconds < whole.seconds
    other = ended(whole.rise * 1.001)
    assert other.seconds == whole.seconds and other.poses[0].tobytes() == whole.poses[0].tobytes()


# ---------------------------------------------------------------------------------------------- fall

COARSE = StepSizes(PHYSICS.step_hz, math.inf)
BOX = asset_of(box(0.1, 0.08, 0.2))


def for_seconds(seconds: float) -> Physics:
    return PHYSICS.model_copy(update={"max_settle_s": seconds})


def test_steps_are_shorter_by_powers_of_two_until_none_goes_too_far_and_never_more_than_sixteen():
    """0.1 mm a step at 960 Hz is 0.096 m/s."""
    rates = {0.0: 1, 0.0959: 1, 0.0961: 2, 0.19: 2, 0.2: 4, 0.7: 8, 1.0: 16, 500.0: FINEST}
    assert {speed: StepSizes(960.0, 1e-4).rate_hz(speed) / 960.0 for speed in rates} == rates


@pytest.mark.parametrize("free_m", [0.0, 0.05, 0.3])
def test_the_part_of_a_fall_that_is_not_simulated_is_exact_and_the_rest_half_a_step_ahead(free_m):
    """Semi-implicit Euler is g t h / 2 ahead after the time t (Hairer, Lubich, Wanner 2006, I.1)."""
    start = start_at(BOX, translation(0.0, 0.0, 2.0))
    motion = fall([make_body(start)], [start.T_world_obj], 0.0, for_seconds(0.4), COARSE, free_m)
    skipped_s = math.sqrt(2.0 * max(0.0, free_m - SKIPPED_TO_M) / GRAVITY_M_S2)
    ahead = GRAVITY_M_S2 * (motion.seconds - skipped_s) / PHYSICS.step_hz / 2
    fallen = 2.0 - motion.poses[0][2, 3]
    assert fallen == pytest.approx(GRAVITY_M_S2 * motion.seconds**2 / 2 + ahead, abs=1e-9)
    assert 0.4 <= motion.seconds <= 0.4 + 8.0 / PHYSICS.step_hz
    assert motion.poses[0][:3, :3] == pytest.approx(np.eye(3), abs=1e-12)


def test_a_stop_condition_ends_the_fall_and_is_named():
    start = start_at(BOX, translation(0.0, 0.0, 1.0))
    stops = {"never": lambda _, at: False, "below": lambda _, at: at[0][2] < 0.9}
    motion = fall([make_body(start)], [start.T_world_obj], 0.0, for_seconds(8.0), COARSE, 0.0, Watch(stops))
    assert (motion.stopped_by, motion.rested) == ("below", False)
    assert 0.9 - 8 * 2.0 / PHYSICS.step_hz <= motion.poses[0][2, 3] < 0.9
    after = motion.speed_m_s - math.sqrt(2 * GRAVITY_M_S2 * 0.1)
    assert 0.0 <= after <= 9 * GRAVITY_M_S2 / PHYSICS.step_hz  # it looks every eight steps
