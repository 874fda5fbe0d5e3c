"""What only colour depends on, and that nothing else does."""

import math

import numpy as np
import pytest

from schemas.job import Job
from schemas.scene import Settled
from tests.shapes import asset_of, box, table
from workers.scene.appearance import draw_look
from workers.scene.effects import Facts, write_receipt
from workers.scene.floors import COVERINGS, TEXTURE_PX, draw_covering
from workers.scene.plan import plan_scene
from workers.scene.randomness import Stream, stream

BOX, TABLE = asset_of(box(0.1, 0.08, 0.2)), table()
JOBS = {tier: Job.model_validate({"name": "t", "seed": 5, "render": {"tier": tier}}) for tier in ("flat", "raster")}


def look(scene: int, tier="raster"):
    return draw_look(stream(5, scene, Stream.APPEARANCE), tier)


def test_the_tier_changes_neither_poses_nor_cameras_nor_the_floors_geometry():
    for scene in range(20):
        flat, raster = (plan_scene(JOBS[tier], scene, TABLE, BOX) for tier in ("flat", "raster"))
        assert flat.objects[0].T_world_obj.tobytes() == raster.objects[0].T_world_obj.tobytes()
        assert flat.input_cameras[0].T_world_cam.tobytes() == raster.input_cameras[0].T_world_cam.tobytes()
        assert flat.floor.vertices.tobytes() == raster.floor.vertices.tobytes()
        assert flat.floor.faces.tobytes() == raster.floor.faces.tobytes()
        assert flat.floor.parts[0].material.texture is None
        assert raster.floor.parts[0].material.texture is not None


def test_a_look_is_a_function_of_its_stream():
    (a, light), (b, same), (c, other) = look(3), look(3), look(4)
    assert a.parts[0].material.texture.tobytes() == b.parts[0].material.texture.tobytes()
    assert a.parts[0].material.texture.tobytes() != c.parts[0].material.texture.tobytes()
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


@pytest.mark.parametrize("kind", COVERINGS)
def test_a_covering_goes_on_where_it_ends(kind):
    """Across the seam neighbouring pixels differ no more than they do elsewhere."""
    shade, roughness = kind(np.random.default_rng(7))
    assert shade.shape == (TEXTURE_PX, TEXTURE_PX, 3) and 0.8 <= roughness <= 1.0
    for axis in (0, 1):
        steps = np.abs(np.diff(shade, axis=axis)).mean(axis=(1 - axis, 2))
        seam = np.abs(np.take(shade, 0, axis) - np.take(shade, -1, axis)).mean()
        assert seam <= steps.max() * 1.05


def test_all_coverings_come_up():
    means = {draw_covering(np.random.default_rng(seed))[1] for seed in range(60)}
    assert len(means) > 10


@pytest.mark.parametrize("tier", ["flat", "raster"])
def test_the_receipt_says_which_effects_of_light_ran(tier):
    rest = Settled(np.eye(4), 0.0, 0.0, 1.0, 0.0, 0.1, "flat_top")
    ran, skipped = write_receipt(Facts(JOBS[tier], plan_scene(JOBS[tier], 0, TABLE, BOX), (rest,), False))
    names = {"shadows", "ambient_occlusion", "antialiasing"}
    assert (names <= set(ran)) == (tier == "raster")
    reasons = {one["effect"]: one["why"] for one in skipped}
    assert (names <= set(reasons)) == (tier == "flat")
    assert all(reasons[name] == "render.tier is flat" for name in names & set(reasons))
