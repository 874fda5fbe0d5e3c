"""MuJoCo makes the same scenes."""

import json
import xml.etree.ElementTree as xml

import numpy as np
import pytest

from services.bench.mujoco_side import describe
from services.bench.others import start_side
from services.bench.stages import make_in_memory


@pytest.mark.minute
def test_mujoco_sees_the_regions_and_depths_that_we_see(bench, given, tmp_path):
    """An independent renderer: all but a few pixels along edges agree, in every view."""
    pytest.importorskip("mujoco")
    bench, span = bench
    with start_side("services.bench.mujoco_side") as mujoco:
        for n, (path, scene) in enumerate(zip(given, make_in_memory(bench.context, span), strict=True)):
            answer = mujoco.ask({"scene": str(path), "out": str(tmp_path), "keep": str(tmp_path / f"{n}.npz")})
            assert set(answer["stages_s"]) == {"scene", "physics", "render"}
            kept = np.load(tmp_path / f"{n}.npz")
            for view in scene.pairs[0].views[:3]:
                same = kept[f"{view.role}0_region"] == view.region
                assert same.mean() > 0.999
                table = same & (view.region == 2) & (view.depth > 0)
                error_m = np.abs(kept[f"{view.role}0_depth"] - view.depth / 5000.0)[table]
                assert np.median(error_m) < 0.0002


def test_the_description_has_every_camera_and_the_body(given):
    scene = json.loads(given[0].read_text())
    model = xml.fromstring(describe(scene))
    cameras = model.findall("worldbody/camera")
    assert [camera.get("name") for camera in cameras] == [f"{role}0" for role in scene["pairs"][0]["cameras"]]
    assert float(model.find("worldbody/body/inertial").get("mass")) == scene["object"]["mass_kg"]
    assert float(cameras[0].get("focalpixel").split()[0]) == scene["intrinsics"]["fx"]
