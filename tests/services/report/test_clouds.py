import base64
import json

import numpy as np
import pytest
import trimesh

from schemas.errors import MachineError
from services.look import clouds as module
from services.look.clouds import Body, coarsen, pack_space, read_space


@pytest.fixture(scope="module")
def space(shown):
    return read_space(shown, 1)


@pytest.mark.parametrize("number", [0, 1])
def test_each_cloud_lies_on_the_mesh_as_a_ray_caster_finds_it(space, number):
    cloud = space.clouds[number]
    mesh = trimesh.util.concatenate(
        [trimesh.Trimesh(body.vertices, body.faces, process=False) for body in space.bodies]
    )
    above = cloud.points[cloud.points[:, 2] > 0.3]  # table and object: the floor has no mesh
    eye = cloud.T_world_cam[:3, 3]
    rays = above - eye
    far = np.linalg.norm(rays, axis=1)
    hit, of, _ = mesh.ray.intersects_location(np.tile(eye, (len(rays), 1)), rays / far[:, None], multiple_hits=False)
    found = np.full(len(rays), np.inf)
    found[of] = np.linalg.norm(hit - eye, axis=1)
    assert len(above) > 500
    assert np.quantile(np.abs(found - far), 0.97) < 0.002


def test_the_clouds_meet_at_the_object_from_both_sides(space):
    assert [cloud.role for cloud in space.clouds] == ["input", "mirror"]
    eyes = [cloud.T_world_cam[:2, 3] - space.target[:2] for cloud in space.clouds]
    assert eyes[0] @ eyes[1] < 0
    assert all(np.linalg.norm(cloud.points - space.target, axis=1).min() < 0.15 for cloud in space.clouds)
    assert {body.kind for body in space.bodies} == {"object", "table"}


def test_of_many_points_those_of_objects_stay(shown, monkeypatch):
    space = read_space(shown, 1)
    low, high = (side([body.vertices for body in space.bodies if body.kind == "object"]) for side in (lowest, highest))
    monkeypatch.setattr(module, "MOST_POINTS", 500)
    whole, thin = space.clouds[0].points, read_space(shown, 1).clouds[0].points
    of_object = [
        ((points > low + np.array([0, 0, 0.01])) & (points < high + 0.005)).all(axis=1).sum()
        for points in (whole, thin)
    ]
    assert len(thin) <= 500 < len(whole)
    assert of_object[0] == of_object[1] > 10


def lowest(parts):
    return np.concatenate(parts).min(axis=0)


def highest(parts):
    return np.concatenate(parts).max(axis=0)


def test_a_mesh_with_too_many_faces_keeps_its_shape(monkeypatch):
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    monkeypatch.setattr(module, "MOST_FACES", 2_000)
    monkeypatch.setattr(module, "GRID_STEPS", 30)
    coarse = coarsen(Body("object", ball.vertices, ball.faces))
    away = np.linalg.norm(coarse.vertices, axis=1)
    assert 0 < len(coarse.faces) < len(ball.faces) / 2
    assert np.abs(away - 0.1).max() < 0.2 / 30


def test_what_is_packed_is_what_is_shown(space):
    packed = json.loads(pack_space(space))
    cloud = packed["clouds"][1]
    points = np.frombuffer(base64.b64decode(cloud["points"]), "<i2").reshape(-1, 3) * packed["quantum"]
    assert np.abs(points + packed["target"] - space.clouds[1].points).max() < 1.1e-4
    assert np.array_equal(
        np.frombuffer(base64.b64decode(cloud["colors"]), np.uint8).reshape(-1, 3), space.clouds[1].colors
    )
    faces = np.frombuffer(base64.b64decode(packed["bodies"][0]["faces"]), "<u4")
    assert np.array_equal(faces.reshape(-1, 3), space.bodies[0].faces)


def test_without_the_jobs_shapes_there_are_clouds_and_the_reason(shown, monkeypatch):
    def gone(*_):
        raise MachineError("the files of the asset folders do not hold what they held")

    monkeypatch.setattr(module, "scene_glb", gone)
    found = read_space(shown, 1)
    assert len(found.clouds) == 2 and found.bodies == ()
    assert "asset folders" in found.missing
