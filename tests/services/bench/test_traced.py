"""The path-traced tier beside Cycles: what is handed over, and what the figures are made of."""

import json
import os
import sys

import numpy as np
import pytest

from schemas.errors import MachineError
from schemas.job.views import Render
from schemas.scene.scene import PosedScene
from services.bench.ratios import Lap
from services.bench.traced import describe, hand_over, start_cycles, summarise
from tests.workers.render.random_scenes import APPEARANCE, camera, orbit_and_mirror, procedural_things
from workers.geometry.frames import transform


def lap(ms_a_view: float) -> Lap:
    return Lap(3, 9.9, 3 * ms_a_view / 1e3, {})


def test_the_ratio_is_of_processor_time_and_says_how_many_views_ours_makes_while_cycles_makes_one():
    laps = [{"ours 16": lap(2000), "cycles 16": lap(5000)}, {"ours 16": lap(4000), "cycles 16": lap(6000)}]
    figures = summarise(laps)
    assert figures["ratio_cpu"]["16"] == pytest.approx({"median": 2.0, "least": 1.5, "most": 2.5})
    assert figures["cpu_ms_per_view"]["ours 16"] == pytest.approx({"median": 3000, "least": 2000, "most": 4000})
    head = {"machine": {"cpu": "some", "load_1min": 0.1}, "command": "verso bench", "core": 1}
    text = "\n".join(describe({**head, "scenes": 2, "cycles": "4.2.0", **figures}))
    assert "at 16 samples: 2.00 [1.50 to 2.50] views" in text


def test_without_cycles_our_side_still_has_its_figures():
    figures = summarise([{"ours 16": lap(2000), "ours 1": lap(200)}])
    assert figures["ratio_cpu"] == {}
    assert figures["cpu_ms_per_view"]["ours 1"]["median"] == pytest.approx(200)


def test_blender_is_given_the_same_vertices_cameras_and_light(tmp_path):
    rng = np.random.default_rng(3)
    things, height = procedural_things(rng)
    view = camera(T=orbit_and_mirror(rng, height)[0].T_world_cam)
    path = hand_over(PosedScene(tuple(things), APPEARANCE), [view], Render(path_bounces=5), tmp_path / "scene")
    told = json.loads(path.read_text())
    assert np.array(told["cameras"][0]) == pytest.approx(view.T_world_cam)
    assert told["bounces"] == 5
    assert told["intrinsics"] == view.intrinsics.model_dump()
    towards = np.array(told["suns"][0]["T_world_light"])[:3, :3]
    assert towards[:, 2] == pytest.approx(APPEARANCE.lights[0].direction)
    assert towards.T @ towards == pytest.approx(np.eye(3), abs=1e-12)
    parts = [(part, thing.T_world_shape) for thing in things for part in thing.shape.parts]
    assert len(told["parts"]) == len(parts)
    for described, (part, T) in zip(told["parts"], parts, strict=True):
        arrays = np.load(path.parent / described["arrays"])
        assert arrays["vertices"] == pytest.approx(transform(T, part.vertices), abs=1e-5)
        assert (arrays["faces"] == part.faces).all()


def test_an_interpreter_without_bpy_is_told_of_by_its_own_words():
    with pytest.raises(MachineError, match="bpy"), start_cycles(sys.executable):
        pass


@pytest.mark.parametrize("python", [os.devnull, "/nowhere/python"])
def test_an_interpreter_that_there_is_not_is_told_of(python):
    with pytest.raises(MachineError, match=python), start_cycles(python):
        pass
