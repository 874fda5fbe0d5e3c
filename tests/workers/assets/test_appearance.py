"""Floors, lights and background."""

import math

import numpy as np
import pytest

from schemas.job.job import Job
from tests.kit.shapes import asset_of, box, table
from workers.assets.look.appearance import (
    FLOOR_KINDS,
    PERIOD_M,
    TEXTURE_PX,
    draw_appearance,
    draw_floor_material,
    make_pattern,
)
from workers.scene.chance import SceneChance, Stream
from workers.scene.draw.plan import draw_scene

BOX, TABLE = asset_of(box(0.1, 0.08, 0.2)), table()
JOBS = {tier: Job.model_validate({"name": "t", "seed": 5, "render": {"tier": tier}}) for tier in ("flat", "raster")}

EVERY = [(kind, number) for kind, floor in enumerate(FLOOR_KINDS) for number in range(floor.patterns)]


def look(scene: int, tier="raster"):
    return draw_appearance(SceneChance(5, scene).stream(Stream.APPEARANCE), tier)


def test_the_tier_changes_neither_poses_nor_cameras_nor_the_floors_geometry():
    for scene in range(20):
        flat, raster = (
            draw_scene(JOBS[tier], SceneChance(JOBS[tier].seed, scene), TABLE, BOX) for tier in ("flat", "raster")
        )
        assert flat.objects[0].T_world_obj.tobytes() == raster.objects[0].T_world_obj.tobytes()
        assert flat.input_cameras[0].T_world_cam.tobytes() == raster.input_cameras[0].T_world_cam.tobytes()
        assert flat.floor.vertices.tobytes() == raster.floor.vertices.tobytes()
        assert flat.floor.faces.tobytes() == raster.floor.faces.tobytes()
        assert flat.floor.parts[0].material.texture is None
        assert raster.floor.parts[0].material.texture is not None


def test_a_look_is_a_function_of_its_stream():
    (a, light), (b, same), (c, other) = look(3), look(3), look(4)
    (here, again, elsewhere) = (floor.parts[0] for floor in (a, b, c))
    assert here.material.texture is again.material.texture
    assert here.material.base_color == again.material.base_color != elsewhere.material.base_color
    assert here.uv.tobytes() == again.uv.tobytes() != elsewhere.uv.tobytes()
    assert light.ambient == same.ambient != other.ambient
    assert [one.color for one in light.lights] == [one.color for one in same.lights]


def test_scenes_are_neither_dark_nor_burnt_out():
    """A level white surface in the middle gets from 0.7 to 1.1 of the light that fills the picture."""
    for scene in range(200):
        light = look(scene)[1]
        level = light.ambient[1] + sum(one.color[1] * float(one.direction[2]) for one in light.lights)
        assert 0.6 < level < 1.15
        assert all(np.linalg.norm(one.direction) == pytest.approx(1.0) for one in light.lights)
        assert light.lights[0].direction[2] > math.sin(0.7) - 1e-9, "shadows stay within the floor's map"
        assert min(light.ambient + light.below + light.background) >= 0.0
    assert {len(look(scene)[1].lights) for scene in range(50)} == {1, 2, 3}


def test_a_floor_goes_on_where_it_ends():
    """Across the seam neighbouring pixels differ no more than they do elsewhere."""
    for kind, number in EVERY:
        texture = make_pattern(kind, number).texture.astype(int)
        assert texture.shape == (TEXTURE_PX, TEXTURE_PX, 3)
        for axis in (0, 1):
            steps = np.abs(np.diff(texture, axis=axis)).mean(axis=(1 - axis, 2))
            seam = np.abs(np.take(texture, 0, axis) - np.take(texture, -1, axis)).mean()
            assert seam <= steps.max() * 1.15, (kind, number)


def test_patterns_are_made_once_and_no_two_are_alike():
    """A renderer keeps what it uploaded by the array's identity, and a process keeps no more than the collection."""
    textures = [make_pattern(*which).texture for which in EVERY]
    assert all(make_pattern(*which).texture is texture for which, texture in zip(EVERY, textures, strict=True))
    assert len({texture.tobytes() for texture in textures}) == len(EVERY)
    assert not any(texture.flags.writeable for texture in textures)
    assert sum(texture.nbytes for texture in textures) < 32 * 1024 * 1024
    drawn = [draw_floor_material(np.random.default_rng(seed)) for seed in range(600)]
    assert {id(material.texture) for material, _ in drawn} == {id(texture) for texture in textures}
    assert len({material.base_color for material, _ in drawn}) == len({period_m for _, period_m in drawn}) == 600
    assert all(PERIOD_M[0] <= period_m <= PERIOD_M[1] and 0.8 <= one.roughness <= 1.0 for one, period_m in drawn)
    assert all(0.1 < c <= 1.0 for material, _ in drawn for c in material.base_color[:3])


def test_a_pattern_leaves_the_floor_the_colour_that_its_kind_drew():
    """White stands for the lightest shade: colour times the texture's mean is the colour times the mean shade."""
    for kind, kind_of_floor in enumerate(FLOOR_KINDS):
        pattern = make_pattern(kind, 0)
        shade = kind_of_floor.draw_shades(np.random.default_rng(np.random.SeedSequence(48_271, spawn_key=(kind, 0))))
        assert pattern.texture.max() == 255
        assert pattern.texture.mean() / 255.0 * pattern.white == pytest.approx(float(np.mean(shade)), abs=0.002)
