"""The simulator's room: the same bits whatever came before, and nothing kept of what was.

Lists for PyBullet, new contents in the same objects; and standard error of compiled code, within the block and after
it. Convex parts as OBJ, read back by the format's rules.
"""

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
from scipy.spatial.transform import Rotation

from schemas.job.job import Job
from schemas.scene.shape import Mesh
from tests.kit.shapes import box
from tests.physics.room import at, ball_body, drop
from workers.geometry.frames import pose, quaternion_from_rotation, rotation_about, uniform_rotation
from workers.physics import bullet
from workers.physics.bullet import DECIMALS, STDERR, BulletBuffers, obj_of, open_world, silence_stderr
from workers.physics.rigid_body import Body, octants

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


def fall(body: Body, T, advances: int = 60):
    with drop(body, T, 0.0, PHYSICS, STEPS) as world:
        for _ in range(advances):
            world.advance()
        return world.pose(), world.velocity()


def test_what_was_simulated_before_leaves_no_trace_in_the_bits():
    T = pose(rotation_about(np.array([0.6, 0.8, 0]), 0.7), np.array([0.01, 0, 0.2]))
    body = body_of(box(0.1, 0.08, 0.2))
    other = dataclasses.replace(body_of(box(0.02, 0.3, 0.1)), mass_kg=7.0)
    results = set()
    for k in range(67):
        results.add(fall(body, T))
        if k % 3:
            fall(other, pose(rotation_about(np.array([1.0, 0, 0]), 0.1 * k), np.array([0, 0, 0.3])), k % 7)
    assert len(results) == 1


def test_worlds_that_begin_without_a_reset_have_the_bits_of_those_that_begin_with_one(monkeypatch):
    """Drops that turn, slide and roll on, some of several bodies or onto a mesh, in three orders."""
    rng = np.random.default_rng(8)
    shapes = [body_of(box(0.1, 0.08, 0.2)), body_of(box(0.02, 0.3, 0.1)), ball_body(0.03)]
    plate = Mesh(np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    drops = []
    for number in range(90):
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


def test_worlds_come_and_go_without_their_memory_staying():
    run = [sys.executable, "-c", GROWTH]
    kilobytes = float(subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()[-1])
    # 400 vertices that PyBullet does not give back are 70 kB in each world, and the plate's indices 20 more; a file of parts
    # that it keeps is 40.
    assert kilobytes < 5.0


@pytest.mark.parametrize("seed", range(10))
def test_quaternions_agree_with_scipy(seed):
    R = Rotation.random(random_state=seed).as_matrix()
    assert abs(quaternion_from_rotation(R) @ Rotation.from_matrix(R).as_quat()) == pytest.approx(1.0)
    half = Rotation.from_rotvec(math.pi * np.eye(3)[seed % 3]).as_matrix()
    assert Rotation.from_quat(quaternion_from_rotation(half)).as_matrix() == pytest.approx(half, abs=1e-12)


def test_no_file_of_parts_stays_behind_also_where_the_disk_is_full(monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    body = body_of(box(0.1, 0.1, 0.1))
    body = dataclasses.replace(body, parts=octants(body.parts[0], 0.01))
    fall(body, at(0.0, 1.0))
    assert list(tmp_path.iterdir()) == []

    def write_half(path, data):
        path.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(Path, "write_bytes", write_half)
    with pytest.raises(OSError, match=r"No space left on device: .*verso-parts-"):
        fall(body, at(0.0, 1.0))
    assert list(tmp_path.iterdir()) == []


def test_longer_and_shorter_lists_have_their_own_contents_in_the_same_objects():
    buffers, rng = BulletBuffers(), np.random.default_rng(0)
    seen = set()
    for count in (5, 2, 7, 7):
        points, values = rng.standard_normal((count, 3)), rng.integers(0, 300, count)
        vertices, indices = buffers.vertices(points), buffers.indices(values)
        assert np.array_equal(vertices, points)
        assert indices == values.tolist()
        seen |= {id(vertices), id(indices), *map(id, vertices)}
    assert len(seen) == 2 + 7


def test_what_c_code_writes_is_dropped_within_the_block_alone(capfd):
    with silence_stderr():
        os.write(STDERR, b"banner")
    os.write(STDERR, b"message")
    assert capfd.readouterr().err == "message"


@pytest.mark.parametrize("size_m", [1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 0.1, 1.0, 9.9, 11.0, 2e4])
def test_coordinates_are_written_as_python_writes_them_with_nine_digits(size_m):
    part = np.round(np.random.default_rng(0).uniform(-size_m, size_m, (500, 3)), DECIMALS)
    lines = [line for line in obj_of([part]).decode("ascii").splitlines() if line.startswith("v")]
    assert lines == ["v " + " ".join(f"{value:.9g}" for value in point) for point in part.tolist()]
