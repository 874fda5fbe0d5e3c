import json

import numpy as np
import pytest
import trimesh

from schemas.scene.shape import Part, Shape
from services.export.bop import BopModels, model_info, ply_lines
from services.export.folder import ExportFolder
from services.export.shapes import color_vertices
from tests.bop_reader import load_model

BOX = trimesh.creation.box((0.1, 0.2, 0.2))
COLORED = color_vertices(Shape((Part("box", np.array(BOX.vertices), np.array(BOX.faces, np.int32)),)))


def asset(name):
    return {"category": "box", "instance_id": name, "split": "train", "source": "mine", "licence": "CC0, or so"}


def test_a_box_has_its_sizes_and_its_diagonal_in_millimetres():
    info = model_info(1000.0 * np.array(BOX.vertices))
    sizes = {"min_x": -50.0, "min_y": -100.0, "min_z": -100.0, "size_x": 100.0, "size_y": 200.0, "size_z": 200.0}
    assert info == pytest.approx({"diameter": 300.0, **sizes})


def test_a_flat_shape_has_a_diameter():
    corners = np.array([[0.0, 0, 0], [30.0, 0, 0], [30.0, 40.0, 0], [0, 40.0, 0]])
    assert model_info(corners)["diameter"] == pytest.approx(50.0, abs=1e-3)


def test_a_part_without_normals_gets_those_of_its_faces(tmp_path):
    (tmp_path / "box.ply").write_bytes(b"".join(ply_lines(COLORED)))
    model = load_model(tmp_path / "box.ply")
    np.testing.assert_allclose(model.vertices, 1000.0 * BOX.vertices, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(model.normals, axis=1), 1.0, atol=1e-5)
    assert ((model.normals * model.vertices).sum(axis=1) > 0).all()
    mesh = trimesh.load(tmp_path / "box.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, model.vertices, atol=1e-4)


def test_numbers_go_on_from_the_last_state(tmp_path):
    folder = ExportFolder(tmp_path / "new")
    with folder.claimed({}):
        first = BopModels(folder, None)
        assert first.number("a") is None and first.add(asset("a"), COLORED) == 1
        state = first.state()
        assert first.add(asset("lost"), COLORED) == 2  # after the last state: a kill takes it back
        first.close()
        again = BopModels(folder, state)
        assert (again.number("a"), again.number("lost")) == (1, None)
        assert again.add(asset("b"), None) == 2 and again.without == 1 and again.count == 2
        again.close()


def test_the_list_of_models_is_json_also_when_it_is_empty(tmp_path):
    for name, shapes, expected in (("none", [], {}), ("two", [COLORED, None, COLORED], {"1", "3"})):
        folder = ExportFolder(tmp_path / name)
        with folder.claimed({}):
            models = BopModels(folder, None)
            for number, shape in enumerate(shapes):
                models.add(asset(f"box {number}"), shape)
            models.finish()
            folder.checkpoint({})
            models.close()
            folder.finish({})
        assert set(json.loads((tmp_path / name / "models" / "models_info.json").read_text())) == set(expected)
