"""What only colour depends on, and that nothing else does."""

import math

import numpy as np
import pytest

from schemas.job.job import Job
from schemas.job.views import Render
from tests.kit.shapes import asset_of, box, table
from workers.assets.appearance import draw_appearance
from workers.scene.effects import Facts, plan_effects, write_receipt
from workers.scene.plan import SceneChance, Stream, draw_scene

BOX, TABLE = asset_of(box(0.1, 0.08, 0.2)), table()
JOBS = {tier: Job.model_validate({"name": "t", "seed": 5, "render": {"tier": tier}}) for tier in ("flat", "raster")}


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


@pytest.mark.parametrize(
    ("tier", "expected"),
    [
        ("flat", set()),
        ("raster", {"shadows", "ambient_occlusion", "antialiasing"}),
        ("pathtraced", {"global_illumination", "glass"}),
    ],
)
def test_the_receipt_says_which_effects_of_light_ran(tier, expected):
    job = JOBS["raster"].model_copy(update={"render": Render(tier=tier)})
    ran, skipped = write_receipt(
        plan_effects(Facts(job, draw_scene(JOBS["raster"], SceneChance(5, 0), TABLE, BOX), False))
    )
    names = {"shadows", "ambient_occlusion", "antialiasing", "global_illumination", "glass"}
    assert names & set(ran) == expected
    reasons = dict.fromkeys(names - expected, f"render.tier is {tier}")
    if tier == "pathtraced":  # paths are shadowed, and spread over a pixel, in any case
        reasons |= dict.fromkeys(("shadows", "antialiasing"), "part of global_illumination")
    assert {one["effect"]: one["why"] for one in skipped if one["effect"] in names} == reasons
