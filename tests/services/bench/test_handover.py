"""The files that the other systems get describe our scene."""

import json

import numpy as np
import pytest
import trimesh

from services.bench.measure import make_in_memory


def test_the_files_have_our_poses_shapes_and_images(bench, given):
    bench, span = bench
    scenes = make_in_memory(bench.context, span)
    for path, scene in zip(given, scenes, strict=True):
        told, start = json.loads(path.read_text()), scene.plan.objects[0]
        assert np.array(told["T_world_obj"]) == pytest.approx(start.T_world_obj)
        assert told["object"]["mass_kg"] == start.asset.mass.mass_kg
        mesh = trimesh.load(path.parent / "object.obj", process=False)
        assert mesh.vertices == pytest.approx(start.asset.shape.mesh.vertices, abs=1e-8)
        assert (mesh.faces == start.asset.shape.mesh.faces).all()
        images = [image["path"] for pair in told["pairs"] for image in pair["images"]]
        assert images and all((bench.store.root / image).is_file() for image in images)
