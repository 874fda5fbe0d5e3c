"""GLB files of scenes, read by hand from glTF 2.0's container and its JSON, and with trimesh."""

import json
import math
import shutil
import struct

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from services.export.graphics import NO_SOURCES
from tests.datasets import make_dataset
from tests.services.export.exported import export_to, source_poses, source_rows, without_sources
from workers.assets.look.surroundings import THICK_M


def read_glb(path):
    """(JSON, binary chunk)."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    binary_size, binary_kind = struct.unpack_from("<I4s", data, 20 + size)
    assert binary_kind == b"BIN\0" and 28 + size + binary_size == length
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def matrix_of(node):
    """[4, 4]; glTF stores columns."""
    assert "translation" not in node and "scale" not in node
    T = np.reshape(node.get("matrix", np.eye(4)), (4, 4)).T
    if "rotation" in node:
        T[:3, :3] = Rotation.from_quat(node["rotation"]).as_matrix()  # x, y, z, w
    return T


def placed(tree):
    """{name: pose in the file's frame, y up} of every node."""
    found = {}

    def walk(number, above):
        node = tree["nodes"][number]
        T = above @ matrix_of(node)
        found[node.get("name", str(number))] = T
        for child in node.get("children", ()):
            walk(child, T)

    for root in tree["scenes"][0]["nodes"]:
        walk(root, np.eye(4))
    return found


Y_UP_FROM_Z_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


@pytest.fixture(scope="module")
def exported(pile, tmp_path_factory):
    folder = tmp_path_factory.mktemp("gltf") / "new"
    manifest = export_to(pile, folder, "gltf").manifest
    (path,) = folder.glob("*/000000.glb")
    return path, manifest


def colors_of(tree):
    """The base colours, which glTF has linear."""
    looks = [one["pbrMetallicRoughness"] for one in tree["materials"]]
    return np.array([look.get("baseColorFactor", [1.0] * 4) for look in looks])


def test_every_object_stands_where_its_row_puts_it_with_y_up_in_the_colours_of_its_stored_shape(pile, exported):
    path, manifest = exported
    assert (manifest["scenes"], sum(manifest["files"].values())) == (1, 1) and type(manifest["scenes"]) is int
    tree, compared = read_glb(path)[0], 0
    nodes, shown = placed(tree), colors_of(tree)
    (row,) = source_rows(pile.root, "scenes")
    for body in row["bodies"]:
        own = [T for name, T in nodes.items() if name.startswith(f"{body['category']} {body['instance_id']} ")]
        assert own
        for factor in colors_of(read_glb(pile.root / f"assets/{body['category']}/{body['instance_id']}.glb")[0]):
            assert np.abs(shown - factor).max(axis=1).min() <= 0.5 / 255 + 1e-6
            compared += 0.05 < factor[0] < 0.95
        for T in own:
            np.testing.assert_allclose(T, Y_UP_FROM_Z_UP @ np.reshape(body["T_world_obj"], (4, 4)), atol=1e-6)
    assert compared and any(name.startswith("floor/") for name in nodes)
    table = next(T for name, T in nodes.items() if name.startswith("table "))
    np.testing.assert_allclose(table, Y_UP_FROM_Z_UP @ np.reshape(row["T_world_table"], (4, 4)), atol=1e-6)


def test_cameras_stand_where_the_views_were_taken_from(pile, exported):
    tree, _ = read_glb(exported[0])
    nodes, poses = placed(tree), source_poses(pile.root)
    optical = np.diag([1.0, -1.0, -1.0, 1.0])  # a glTF camera looks along -z with y up
    for name, pose_id in (("input 0", 0), ("mirror 1", 1)):
        np.testing.assert_allclose(nodes[name], Y_UP_FROM_Z_UP @ poses[pose_id] @ optical, atol=1e-6)
    assert [camera["name"] for camera in tree["cameras"]] == ["input 0", "aligned 0", "mirror 1"]
    perspective = tree["cameras"][0]["perspective"]
    assert perspective["yfov"] == pytest.approx(2 * math.atan(60 / 131.25))
    assert perspective["aspectRatio"] == pytest.approx(160 / 120)


@pytest.mark.minute
def test_walls_and_clutter_stand_where_the_scene_has_them(tmp_path):
    look = {"room": True, "clutter": {"count": 2}, "environment": {"built_in": ["window_room"]}}
    store, _ = make_dataset(tmp_path / "out", scenes=1, categories=["can"], look=look)
    (around,) = (row["surroundings"] for row in source_rows(store.root, "scenes"))
    assert around["clutter"]
    export_to(store, tmp_path / "new", "gltf")
    (path,) = (tmp_path / "new").glob("*/*.glb")
    nodes, posed = placed(read_glb(path)[0]), trimesh.load_scene(path)
    for piece in around["clutter"]:
        name = f"clutter {piece['category']} {piece['instance_id']} {piece['region_id']}/"
        own = [T for node, T in nodes.items() if node.startswith(name)]
        assert own
        for T in own:
            np.testing.assert_allclose(T, Y_UP_FROM_Z_UP @ np.reshape(piece["T_world_obj"], (4, 4)), atol=1e-6)
    corners = np.concatenate([mesh.vertices for name, mesh in posed.geometry.items() if name.startswith("walls/")])
    length, width, height = around["room_m"]
    np.testing.assert_allclose(np.abs(corners).max(axis=0)[:2], [length / 2 + THICK_M, width / 2 + THICK_M], atol=1e-6)
    assert corners[:, 2].max() == pytest.approx(height) and corners[:, 2].min() == pytest.approx(0.0)


def test_captures_have_their_board_and_scenes_with_neither_shapes_nor_sources_are_left_out(captures, pile, tmp_path):
    export_to(captures, tmp_path / "new", "gltf")
    paths = sorted((tmp_path / "new" / "mug").glob("*.glb"))
    assert [path.name for path in paths] == ["000000.glb", "000001.glb"]
    names = placed(read_glb(paths[0])[0])
    assert any(name.startswith("board ") for name in names) and any(name.startswith("mug ") for name in names)
    stored = without_sources(pile, tmp_path / "copy")
    assert export_to(stored, tmp_path / "stored", "gltf").manifest["pairs"] == 1
    shutil.rmtree(stored.root / "assets")
    manifest = export_to(stored, tmp_path / "none", "gltf").manifest
    assert (manifest["pairs"], manifest["left_out"]) == (0, {NO_SOURCES: 1})


def test_a_studio_scene_is_its_object_and_every_camera_that_the_job_names(studio, tmp_path):
    export_to(studio, tmp_path / "new", "gltf", last_scene=0)
    (path,) = (tmp_path / "new").glob("*/000000.glb")
    nodes = placed(read_glb(path)[0])
    assert not any(name.startswith(("floor", "table")) for name in nodes)
    views = [row for row in source_rows(studio.root, "views") if row["role"] == "around" and not row["scene_id"]]
    for view in views:
        T = Y_UP_FROM_Z_UP @ np.reshape(view["T_world_cam"], (4, 4)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(nodes[f"around_{view['number']:03d} 0"], T, atol=1e-6)
    assert len(views) == 4
