import json

import numpy as np
import pytest
import trimesh

from schemas.errors import InputError
from services.read.query import query
from services.read.scene_geometry import export_scene


def test_the_exported_scene_has_every_object_where_its_row_puts_it(three_objects, tmp_path):
    size = export_scene(three_objects, 0, tmp_path / "new" / "scene.glb")
    assert size == (tmp_path / "new" / "scene.glb").stat().st_size
    scene = trimesh.load(tmp_path / "new" / "scene.glb")
    (row,) = query(three_objects, "select bodies from scenes").to_pylist()
    for body in row["bodies"]:
        name = f"{body['category']} {body['instance_id']} {body['region_id']}"
        nodes = [node for node in scene.graph.nodes_geometry if node.startswith(name + "/")]
        assert nodes
        for node in nodes:
            np.testing.assert_allclose(scene.graph[node][0], np.reshape(body["T_world_obj"], (4, 4)), atol=1e-6)
    assert {"floor", "table"} <= {node.split("/")[0].split(" ")[0] for node in scene.graph.nodes_geometry}


def test_a_scene_that_is_not_there_is_refused(three_objects, tmp_path):
    with pytest.raises(InputError, match="scene 7 is not in"):
        export_scene(three_objects, 7, tmp_path / "scene.glb")
    assert not list(tmp_path.iterdir())


def test_colours_are_linear_as_gltf_has_them(three_objects, tmp_path):
    """The stored shapes of the same objects, whose colours are linear, say which colours the scene must have."""
    export_scene(three_objects, 0, tmp_path / "scene.glb")

    def factors(path):
        data = path.read_bytes()
        tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
        return [material["pbrMetallicRoughness"].get("baseColorFactor", [1.0] * 4) for material in tree["materials"]]

    (row,) = query(three_objects, "select bodies from scenes").to_pylist()
    shown, compared = np.array(factors(tmp_path / "scene.glb")), 0
    for body in row["bodies"]:
        for factor in factors(three_objects.root / "assets" / body["category"] / f"{body['instance_id']}.glb"):
            assert np.abs(shown - factor).max(axis=1).min() <= 0.5 / 255 + 1e-6
            compared += 0.05 < factor[0] < 0.95
    assert compared
