"""Views from all sides, read back by the formulas of the loaders of Zero123, InstantMesh, TRELLIS, nerfstudio and Middlebury.

Where the loaders say it: ldm/data/simple.py; src/data/objaverse.py and renderer/utils/ray_sampler.py;
trellis/datasets/sparse_feat2render.py. Nothing of this project is imported for reading.
"""

import csv
import io
import json
import math
import re
from collections.abc import Callable

import numpy as np
import pytest
import trimesh
import yaml

from schemas.errors import InputError
from tests.datasets import make_dataset
from tests.judge.nearest import distances_to_faces
from tests.services.export.exported import export_to, source_rows
from tests.services.export.image_loaders import read_picture
from tests.services.export.test_sharded import decode, rows_of, samples_of

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Between cameras that look along -z and those that look along z."""
STEP = 6.0 / 255.0
"""Of InstantMesh's depth, in its unit."""


class Shot:
    """A view as a loader has it: RGBA, [4, 4] camera (OpenCV) to object, focal length in widths, depth and normals or None."""

    def __init__(self, path, T, focal, depth=None, normals=None):
        self.rgba, self.T, self.focal, self.depth, self.normals = read_picture(path), T, focal, depth, normals
        assert self.rgba.ndim == 3 and self.rgba.shape[2] == 4 and self.rgba.dtype == np.uint8

    def pixels_of(self, points):
        """[N, 2] columns and rows of points [N, 3] of the object's frame, pixel centres at +0.5."""
        inside = (points - self.T[:3, 3]) @ self.T[:3, :3]
        return len(self.rgba) * (self.focal * inside[:, :2] / inside[:, 2:] + 0.5)

    def points(self):
        """([N, 3] in the object's frame of pixels that have depth, their rows and columns)."""
        rows, columns = np.nonzero(self.depth > 0)
        z = self.depth[rows, columns]
        x, y = ((n + 0.5) / len(self.rgba) - 0.5 for n in (columns, rows))
        return np.stack([x / self.focal * z, y / self.focal * z, z], axis=1) @ self.T[:3, :3].T + self.T[:3, 3], (
            rows,
            columns,
        )


def closed(matrix):
    """[4, 4] of [3, 4]."""
    return np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])


def load_zero123(root):
    """Shots by name; the field of view is not stored."""
    for name in json.loads((root / "valid_paths.json").read_text()):
        count = len(list((root / name).glob("*.png")))
        poses = [np.linalg.inv(closed(np.load(root / name / f"{n:03d}.npy"))) @ FLIP for n in range(count)]
        yield name, [Shot(root / name / f"{n:03d}.png", T, None) for n, T in enumerate(poses)]


def load_instantmesh(root):
    """What `load_im` and `__getitem__` make of a folder."""
    for name in json.loads((root / "filtered_obj_name.json").read_text())["good_objs"]:
        place = root / "rendering_random_32views" / name
        poses = np.load(place / "cameras.npz")["cam_poses"]
        assert poses.shape[1:] == (3, 4)
        shots = []
        for n, pose in enumerate(poses):
            depth, normals = (read_picture(place / f"{n:03d}_{kind}.png") for kind in ("depth", "normal"))
            assert depth.ndim == 2 and depth.dtype == np.uint8 and normals.shape[2] == 4
            T = np.linalg.inv(closed(pose)) @ FLIP
            shots.append(Shot(place / f"{n:03d}.png", T, None, depth * STEP, normals[..., 2::-1] / 127.5 - 1.0))
        yield name, shots


def load_trellis(root, folder="renders"):
    """`_get_image` of every frame, and depth as that project's script stores it."""
    with (root / "metadata.csv").open() as file:
        names = [row["sha256"] for row in csv.DictReader(file)]
    for name in names:
        place, shots = root / folder / name, []
        for frame in json.loads((place / "transforms.json").read_text())["frames"]:
            path, depth = place / frame["file_path"], None
            if "depth" in frame:
                codes, ends = read_picture(path.with_name(f"{path.stem}_depth.png")), frame["depth"]
                assert codes.dtype == np.uint16
                depth = np.where(codes < 65_535, ends["min"] + codes / 65_535 * (ends["max"] - ends["min"]), 0.0)
            focal = 0.5 / math.tan(frame["camera_angle_x"] / 2)
            shots.append(Shot(path, np.array(frame["transform_matrix"]) @ FLIP, focal, depth))
        yield name, shots


def load_nerf(root):
    """The views of named cameras that stand by themselves."""
    for path in root.glob("*/transforms.json"):
        frames = [f for f in json.loads(path.read_text())["frames"] if re.search("around|near", f["file_path"])]
        assert all(frame["depth_path"] == frame["depth_file_path"] for frame in frames)
        poses = [np.array(frame["transform_matrix"]) @ FLIP for frame in frames]
        files = [path.parent / frame["file_path"] for frame in frames]
        focals = [frame["fl_x"] / frame["w"] for frame in frames]
        yield f"-{path.parent.name}", [Shot(*each) for each in zip(files, poses, focals, strict=True)]


LAYOUTS: dict[str, tuple[Callable, float | None]] = {
    "zero123": (load_zero123, 1.0),
    "instantmesh": (load_instantmesh, 2.0),
    "trellis": (load_trellis, 1.0),
    "nerf": (load_nerf, None),  # metres, in the world
}
COUNT = 6
FOCALS = [100.0 / 96.0] * 4 + [0.5 / math.tan(math.radians(30.0))] * 2
"""In widths, of the ring and of the sphere of the fixture."""


@pytest.fixture(scope="module")
def read(studio, tmp_path_factory):
    """{layout: {scene id: shots}}."""
    place = tmp_path_factory.mktemp("multiview")
    shots = {}
    for name, (load, _) in LAYOUTS.items():
        manifest = export_to(studio, place / name, name).manifest
        assert (manifest["scenes"], manifest["pairs_left_out"]) == (3, 0)
        roots = [path for path in (place / name).iterdir() if path.is_dir()]
        shots[name] = {int(key.rpartition("-")[2]): of for root in roots for key, of in load(root)}
        for shot, focal in (
            (shot, focal) for of in shots[name].values() for shot, focal in zip(of, FOCALS, strict=True)
        ):
            shot.focal = shot.focal or focal
            assert shot.focal == pytest.approx(focal, rel=1e-12)
    return shots


def mesh_of(studio, scene_id, side):
    """(row of a scene, its object turned as it stands, the ends of the object's box in the world, metres).

    In a layout's frame the box is in the middle and `side` long; without a side the mesh is in the world too.
    """
    (row,) = (row for row in source_rows(studio.root, "scenes") if row["scene_id"] == scene_id)
    path = studio.root / "assets" / row["category"] / f"{row['instance_id']}.glb"
    mesh = trimesh.load_scene(path, process=False).to_mesh()
    T = np.reshape(row["T_world_obj"], (4, 4))
    assert not np.allclose(T, np.eye(4))
    mesh.apply_transform(T)
    bounds = mesh.bounds.copy()
    if side is not None:
        mesh.apply_translation(-bounds.mean(axis=0))
        mesh.apply_scale(side / mesh.extents.max())
    return row, mesh, bounds


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_object_is_drawn_where_each_layouts_cameras_see_it(name, read, studio):
    """The box of a silhouette is the box of the mesh's projected vertices."""
    side = LAYOUTS[name][1]
    assert sorted(read[name]) == [0, 1, 2]
    for scene_id, shots in read[name].items():
        _, mesh, _ = mesh_of(studio, scene_id, side)
        assert len(shots) == COUNT
        for shot in shots:
            rows, columns = np.nonzero(shot.rgba[..., 3] >= 128)
            seen = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
            pixels = shot.pixels_of(mesh.vertices)
            np.testing.assert_allclose(seen, [*pixels.min(axis=0), *pixels.max(axis=0)], atol=1.0)
            assert np.linalg.det(shot.T[:3, :3]) == pytest.approx(1.0)


def test_distances_are_in_units_of_the_longest_side_from_the_middle_of_the_box(read, studio):
    rows = [row for row in source_rows(studio.root, "views") if row["role"] in ("around", "near")]
    for name, (_, side) in LAYOUTS.items():
        for scene_id, shots in read[name].items():
            _, mesh, bounds = mesh_of(studio, scene_id, side)
            origin, unit = (
                bounds.mean(axis=0) - mesh.bounds.mean(axis=0),
                mesh.extents.max() / np.ptp(bounds, axis=0).max(),
            )
            stored = sorted(
                (row["role"], row["number"], row["T_world_cam"]) for row in rows if row["scene_id"] == scene_id
            )
            for shot, (*_, T) in zip(shots, stored, strict=True):
                place = np.reshape(T, (4, 4))[:3, 3]
                np.testing.assert_allclose(shot.T[:3, 3], unit * (place - origin), atol=1e-9)


@pytest.mark.minute
@pytest.mark.parametrize(("name", "tolerance"), [("instantmesh", 0.6 * STEP), ("trellis", 2e-4)])
def test_depth_lies_on_the_object(name, tolerance, read, studio):
    for scene_id, shots in read[name].items():
        _, mesh, _ = mesh_of(studio, scene_id, LAYOUTS[name][1])
        for shot in shots:
            points, _ = shot.points()
            assert len(points) > 300
            assert distances_to_faces(points[::7], mesh.triangles).max() < tolerance


def test_normals_point_out_of_the_object_in_the_worlds_axes(read):
    """They are at right angles to the surface between neighbouring pixels, which finer depth gives, and face the camera."""
    for scene_id, shots in read["instantmesh"].items():
        for shot, fine in zip(shots, read["trellis"][scene_id], strict=True):
            points, pixels = fine.points()
            grid = np.full((*fine.depth.shape, 3), np.nan)
            grid[pixels] = points
            there = np.abs(shot.normals + 1.0).max(axis=2) > 0.0
            assert (there != (fine.depth > 0)).sum() < 5 and (there & (shot.rgba[..., 3] == 0)).sum() < 5
            points, pixels = points[there[pixels]], np.nonzero(there & (fine.depth > 0))
            normals = shot.normals[pixels]
            np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=0.02)
            assert ((fine.T[:3, 3] - points) * normals).sum(axis=1).min() > -0.01
            for axis in (0, 1):
                along = np.roll(grid, -1, axis)[pixels] - points
                lean = np.abs((along * normals).sum(axis=1)) / np.linalg.norm(along, axis=1)
                assert np.nanmedian(lean) < 0.02


def test_trellis_has_input_views_as_conditions_and_the_mesh_in_its_cube(studio, tmp_path):
    assert export_to(studio, tmp_path / "new", "trellis").manifest["scenes"] == 3
    for root in (path for path in (tmp_path / "new").iterdir() if path.is_dir()):
        for name, (shot,) in load_trellis(root, "renders_cond"):
            row, mesh, bounds = mesh_of(studio, int(name.rpartition("-")[2]), 1.0)
            stored = trimesh.load_mesh(root / "renders" / name / "mesh.ply", process=False)
            np.testing.assert_allclose(stored.bounds, mesh.bounds, atol=1e-6)
            assert len(stored.faces) == len(mesh.faces)
            tree = json.loads((root / "renders" / name / "transforms.json").read_text())
            for frame in tree["frames"]:
                radius, ends = np.linalg.norm(np.array(frame["transform_matrix"])[:3, 3]), frame["depth"]
                assert [ends["min"], ends["max"]] == pytest.approx([radius - math.sqrt(0.75), radius + math.sqrt(0.75)])
            assert tree["aabb"] == [[-0.5] * 3, [0.5] * 3]
            np.testing.assert_allclose(tree["scale"] * bounds + tree["offset"], mesh.bounds, atol=1e-9)
            stored = read_picture(studio.root / row["category"] / f"RGB{2 * row['scene_id']:05d}.png")
            np.testing.assert_array_equal(shot.rgba, stored)


def test_stereo_disparity_is_the_shift_between_the_two_cameras(studio, tmp_path):
    manifest = export_to(studio, tmp_path / "new", "stereo").manifest
    assert sum(manifest["folders"].values()) == 6
    views = {(row["pose_id"], row["role"]): row for row in source_rows(studio.root, "views")}
    for folder in tmp_path.glob("new/*/*-*"):
        _, pose_id, name = folder.name.split("-")
        names = ["input", name] if name == "right" else [name, "input"]
        pair = [views[int(pose_id), role] for role in names]
        cameras = [np.reshape(view["T_world_cam"], (4, 4)) for view in pair]
        calibration = dict(line.split("=") for line in (folder / "calib.txt").read_text().split("\n") if line)
        assert calibration["cam0"] == "[100.0 0 47.5; 0 100.0 47.5; 0 0 1]" and calibration["width"] == "96"
        assert float(calibration["baseline"]) == (250.0 if name == "right" else 125.0)
        for number, (here, there) in enumerate((cameras, cameras[::-1])):
            word = "" if names[number] == "input" else f"_{names[number]}_"
            end = "" if names[number] == "input" else "_000"
            place = studio.root / pair[number]["category"]
            depth = read_picture(place / f"depth{word}{int(pose_id):05d}{end}.png") / pair[number]["depth_units_per_m"]
            picture = (place / f"RGB{word}{int(pose_id):05d}{end}.png").read_bytes()
            assert (folder / f"im{number}.png").read_bytes() == picture
            disparity = read_picture(folder / f"disp{number}.pfm")
            np.testing.assert_array_equal(np.isfinite(disparity), depth > 0)
            rows, columns = np.nonzero(depth > 0)
            z = depth[rows, columns]
            points = np.stack([(columns + 0.5 - 48.0) / 100.0 * z, (rows + 0.5 - 48.0) / 100.0 * z, z], axis=1)
            beyond = (points @ here[:3, :3].T + here[:3, 3] - there[:3, 3]) @ there[:3, :3]
            shift = columns + 0.5 - (100.0 * beyond[:, 0] / beyond[:, 2] + 48.0)
            np.testing.assert_allclose(disparity[rows, columns], shift * (1 - 2 * number), atol=1e-3)
            np.testing.assert_allclose(100.0 * beyond[:, 1] / beyond[:, 2] + 48.0, rows + 0.5, atol=1e-3)
            assert len(z) > 300 and disparity[rows, columns].min() > 1.0


@pytest.mark.parametrize("name", ["webdataset", "huggingface"])
def test_every_view_of_a_named_camera_is_in_the_row_of_its_pair(name, studio, tmp_path):
    export_to(studio, tmp_path / "new", name)
    views = [row for row in source_rows(studio.root, "views") if row["number"] is not None]
    samples = (
        {int(key): each for (_, key), each in samples_of(tmp_path / "new").items()} if name == "webdataset" else {}
    )
    rows = {row["pose_id"]: row for row in rows_of(tmp_path / "new")} if name == "huggingface" else {}
    assert len(samples or rows) == 3 and len(views) == 3 * (COUNT + 2)
    for view in views:
        pose_id, role, number = view["pose_id"], view["role"], view["number"]
        ending = f"_{role}_{pose_id:05d}_{number:03d}.png"
        rgb, depth = (studio.root / view["category"] / f"{word}{ending}" for word in ("RGB", "depth"))
        if samples:
            key = f"{role}_{number:03d}"
            stored = json.loads(samples[pose_id]["json"])["views"][key]
            assert samples[pose_id][f"{key}.rgb.png"] == rgb.read_bytes()
            arrays = np.load(io.BytesIO(samples[pose_id]["depth.npz"]))
            np.testing.assert_array_equal(arrays[key], read_picture(depth))
            assert [thing["region_id"] for thing in stored["objects"]] == [3]
        else:
            stored = rows[pose_id][f"{role}_view"][number]
            assert rows[pose_id][f"{role}_rgb"][number]["bytes"] == rgb.read_bytes()
            np.testing.assert_array_equal(decode(rows[pose_id][f"{role}_depth"][number]["bytes"]), read_picture(depth))
            assert (role, number) in {(thing["role"], thing["number"]) for thing in rows[pose_id]["objects"]}
        assert stored["T_world_cam"] == view["T_world_cam"] and stored["fx"] == view["fx"]
    if rows:
        body = (tmp_path / "new" / "README.md").read_text()
        assert (
            "`around_rgb`: for each view: image" in body
            and yaml.safe_load(body.split("---\n")[1])["license"] == "cc0-1.0"
        )


def test_what_a_layout_cannot_hold_is_refused_with_the_key_to_change(files, tmp_path):
    for name, store, message in (
        ("stereo", files, r"stereo needs a camera of cameras\.more beside another.*offset_m: \[0\.1, 0, 0\]"),
        ("instantmesh", files, r"instantmesh needs .*targets\.views: \[normals\].*lacks normals"),
    ):
        with pytest.raises(InputError, match=message):
            export_to(store, tmp_path / "new", name)
    lens, _ = make_dataset(tmp_path / "lens", scenes=1, sensor={"distortion": {"k1": 0.05}})
    with pytest.raises(InputError, match=r"zero123 needs colour of a pinhole camera.*sensor\.distortion"):
        export_to(lens, tmp_path / "new", "zero123")
    (reason,) = export_to(files, tmp_path / "wide", "zero123").manifest["left_out"]
    assert "not a square picture" in reason


def test_without_further_cameras_an_object_on_a_table_is_cut_out_of_its_pairs(tmp_path):
    sensor = {"width": 120, "height": 120, "fx": 130.0, "fy": 130.0, "cx": 60.0, "cy": 60.0}
    store, _ = make_dataset(tmp_path / "table", scenes=1, categories=["can"], cameras={"sensor": sensor})
    assert export_to(store, tmp_path / "new", "zero123").manifest["views_of_an_object"] == [3]
    (root,) = (path for path in (tmp_path / "new").iterdir() if path.is_dir())
    ((_, shots),) = load_zero123(root)
    for shot, word in zip(shots, ("segment00000", "segmentAligned00000", "segment00001"), strict=True):
        np.testing.assert_array_equal(
            shot.rgba[..., 3], np.where(read_picture(store.root / "can" / f"{word}.png") == 3, 255, 0)
        )


def test_point_completion_has_a_partial_cloud_of_every_view(studio, tmp_path):
    manifest = export_to(studio, tmp_path / "new", "pcn").manifest
    assert sum(manifest["partial"].values()) == 3 * (1 + COUNT + 2)
    with (tmp_path / "new" / "views.csv").open() as file:
        assert {row["role"] for row in csv.DictReader(file)} >= {"input", "around_003", "near_001", "right_000"}
