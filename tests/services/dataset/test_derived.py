"""What follows from the images of a pair, against meshes and ray casts: clouds, targets, boxes, correspondence, point sets."""

import dataclasses
import itertools

import numpy as np
import pytest
import trimesh

from schemas.errors import CorruptError, InputError
from schemas.scene.scene import Placed
from services.dataset.dataset import make_scene, open_dataset
from services.dataset.pair import Pair
from tests.kit.shapes import shape_of
from workers.geometry.raycast import cast_view, edge_distance_px, first_hit

TARGETS = {"views": ["normals", "coordinates", "albedo", "covisible", "amodal", "layers"]}
JOB = {"name": "derived", "seed": 2024, "targets": TARGETS, "images": {"projection": {"enabled": False}}}
SIZES = {"objects": [{"source": "procedural", "size": "metric"}]}
PILE = {
    "objects_per_scene": 3,
    "categories": ["mug", "box", "bowl"],
    "start": {"arrange": "pile"},
    "assets": SIZES,
}
UNIT_M = 1e-4
"""Half a unit of stored depth."""
EDGE_ON = np.sin(np.radians(10.0))
"""Least cosine of incidence that is judged: of a steeper surface the next pixel may show a place centimetres away."""


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    """A bowl, a laptop, and a pile of three; every target."""
    scenes = (JOB | {"categories": ["bowl"]}, 1), (JOB | {"categories": ["laptop"]}, 1), (JOB | PILE, 0)
    return [pair for job, scene in scenes for pair in make_scene(job, scene)]


def views_of(pairs):
    return [(pair, view) for pair in pairs for view in (pair.input, pair.aligned, pair.mirror)]


def objects_of(view):
    return [one.region_id for one in view.objects if one.region_id >= 3]


def to(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def off_surface(mesh, points):
    """Distance of points from a mesh, and its nearest face."""
    _, distance, face = trimesh.proximity.closest_point(mesh, points)
    return distance, face


def things_of(pair) -> list[Placed]:
    """Floor, table and objects, from the stored shapes."""
    floor = trimesh.Trimesh([[x, y, 0] for x in (-50, 50) for y in (-50, 50)], [[0, 2, 1], [1, 2, 3]], process=False)
    meshes = {1: floor} | {number: pair.mesh(number, welded=True) for number in pair.T_world}
    return [Placed(number, shape_of(mesh), np.eye(4)) for number, mesh in meshes.items()]


@pytest.mark.minute
def test_a_cloud_lies_on_the_mesh_in_every_frame(pairs):
    for pair, view in views_of(pairs):
        for number in objects_of(view):
            clouds = {frame: view.cloud(frame, number) for frame in ("object", "camera", "world")}
            own, camera, world = clouds.values()
            assert np.array_equal(view.segment()[tuple(own.pixels.T)], np.full(len(own.points), number))
            assert np.array_equal(own.colours, view.rgb()[tuple(own.pixels.T)])
            some = slice(None, None, max(1, len(own.points) // 300))
            for cloud, mesh in ((camera, view.mesh(number)), (world, pair.mesh(number))):
                assert off_surface(mesh, cloud.points[some])[0].max(initial=0) < 1.3 * UNIT_M
            T_cam_obj = next(one.T_cam_obj for one in view.objects if one.region_id == number)
            assert np.allclose(to(T_cam_obj, own.points), camera.points, atol=1e-12)
            assert np.allclose(own.normals @ T_cam_obj[:3, :3].T, camera.normals) and len(own.normals)
            assert (camera.normals * camera.points).sum(axis=1).max() < 1e-3  # towards the camera
            u, v, w = (view.K @ camera.points.T) / camera.points[:, 2]
            assert np.allclose(np.stack([v, u], axis=1) - 0.5, own.pixels) and np.allclose(w, 1)
        everything = view.cloud("camera", None)
        assert len(everything.points) == (view.depth() > 0).sum()
        assert len(view.cloud("world", 1).points) and np.abs(view.cloud("world", 1).points[:, 2]).max() < 2 * UNIT_M


@pytest.mark.minute
def test_targets_are_the_mesh_in_numbers(pairs):
    for _, view in views_of(pairs):
        segment, normals, coordinates = view.segment(), view.normals(), view.coordinates()
        length = np.linalg.norm(normals, axis=2)
        assert np.abs(length[segment > 0] - 1).max() < 1e-6 and not length[segment == 0].any()
        assert (
            np.array_equal(np.isnan(coordinates).any(axis=2), segment < 3) and view.albedo().shape == view.rgb().shape
        )
        depth, region = view.layers()
        first = (segment >= 3) & (view.depth() > 0)
        assert depth.shape == (4, *segment.shape)
        assert (np.abs(depth[0] - view.depth_m())[first] < 2.1 * UNIT_M).mean() > 0.999
        assert np.array_equal(region[0][first], segment[first])
        for number in objects_of(view):
            mesh, cloud = view.mesh(number), view.cloud("object", number)
            at = tuple(cloud.pixels.T)
            T_cam_obj = next(one.T_cam_obj for one in view.objects if one.region_id == number)
            some = slice(None, None, max(1, len(cloud.points) // 300))
            distance, face = off_surface(mesh, to(T_cam_obj, coordinates[at][some]))
            assert distance.max(initial=0) < 1e-5  # the box's diagonal over 65,535 is 4 micrometres
            assert np.linalg.norm(coordinates[at] - cloud.points, axis=1).max(initial=0) < 1.5 * UNIT_M
            cosine = np.abs((mesh.face_normals[face] * normals[at][some]).sum(axis=1))
            assert not len(cosine) or (cosine > 0.999).mean() > 0.9  # else at an edge, where two faces are as near
            assert not (view.segment() == number)[~view.amodal(number)].any()
            if view.role != "input":
                assert not (view.covisible() & (segment < 3)).any() and view.covisible().any()
            assert view.amodal(number).sum() == view.regions[number]["amodal_pixels"]


def test_thickness_is_the_way_from_the_first_surface_to_the_last(pairs):
    for _, view in views_of(pairs):
        thickness, segment = view.thickness_m(), view.segment()
        assert np.isnan(thickness[segment < 3]).all()
        for number in objects_of(view):
            rows, columns = np.nonzero((segment == number) & ~np.isnan(thickness))
            rows, columns = (at[:: max(1, len(rows) // 200)] for at in (rows, columns))
            rays = (np.linalg.inv(view.K) @ np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])).T
            mesh = view.mesh(number, welded=True)
            places, at, _ = mesh.ray.intersects_location(np.zeros_like(rays), rays)
            reached = np.linalg.norm(places, axis=1)
            cast = np.array([np.ptp(reached[at == n]) if (at == n).any() else np.nan for n in range(len(rays))])
            assert np.nanmedian(np.abs(cast - thickness[rows, columns])) < 2 * UNIT_M if len(rows) else True
            assert not len(rows) or (np.abs(cast - thickness[rows, columns]) < 5 * UNIT_M).mean() > 0.95


@pytest.mark.minute
@pytest.mark.parametrize("back", [False, True])
def test_no_pixel_off_outlines_is_seen_or_hidden_wrongly(pairs, back, record_figure):
    """Rays from the other camera to what exact rays of this one meet; an outline, of either image, is a pixel wide."""
    for pair in pairs:
        source, target = (pair.mirror, pair.input) if back else (pair.input, pair.mirror)
        things, k, eye = things_of(pair), target.camera.intrinsics, target.T_world_cam[:3, 3]
        depth, region, own_cosine = cast_view(things, source.camera)
        known = (region == source.segment()) & (np.abs(depth - source.depth() / 5000.0) < 2 * UNIT_M) & (depth < 8.0)
        rows, columns = np.nonzero(known)
        rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))]) * depth[known]
        points = to(source.T_world_cam, (np.linalg.inv(source.K) @ rays).T)
        hit = first_hit(things, np.tile(eye, (len(points), 1)), points - eye)
        seen = np.abs(1 - hit.distance) * np.linalg.norm(points - eye, axis=1) < UNIT_M
        local = to(np.linalg.inv(target.T_world_cam), points)
        u, v, _ = (target.K @ local.T) / local[:, 2]
        inside = (local[:, 2] > 0) & (u > 0) & (u < k.width) & (v > 0) & (v < k.height)
        found = pair.correspondence(back)
        off = np.abs(found.uv[known] - np.stack([u, v], axis=1)).max(axis=1)
        assert np.nanmedian(off) < 0.03 and np.array_equal(np.isnan(off), local[:, 2] <= 0)
        border = (np.abs(np.stack([u, u - k.width, v, v - k.height])) < 1).any(axis=0)
        clear = np.minimum(own_cosine[known], np.where(seen, hit.incidence_cos, 1.0)) > EDGE_ON
        wrong = (found.visible[known] != (seen & inside)) & clear & ~border & (local[:, 2] < 7.99)
        pixels = np.stack([rows, columns], axis=1)[wrong], np.stack([v, u], axis=1)[wrong] - 0.5
        edges = [
            edge_distance_px(things, one.camera, at, True) for one, at in zip((source, target), pixels, strict=True)
        ]
        lax = pair.correspondence(back, tolerance_m=1.0)
        at = np.floor(lax.uv[lax.visible]).astype(int)
        assert np.array_equal(target.segment()[at[:, 1], at[:, 0]], source.segment()[lax.visible])
        bad = int((np.minimum(*edges) > 1).sum())
        record_figure(f"visibility off outlines, {pair.category}, back {back}", "must agree", bad, 0)
        assert (
            clear.mean() > 0.95
            and bad == 0
            and wrong.sum() < 0.02 * (seen & inside).sum()
            and (~seen & inside).sum() > 500
        )
        centre = np.stack(np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5), axis=2)
        assert np.allclose(pair.flow(back) + centre, found.uv, equal_nan=True)


def test_boxes_hold_the_shapes_in_the_camera_and_in_the_image(pairs, captures):
    every = [*views_of(pairs), *views_of([next(open_dataset(captures.root).pairs())])]
    for pair, view in ((pair, view) for pair, view in every if view is not None):
        for number in objects_of(view) if view.row["capture"] else pair.T_world:
            box, T_obj_world = view.box(number), np.linalg.inv(pair.T_world[number])
            own = to(T_obj_world, pair.mesh(number).vertices)
            corners = to(T_obj_world @ view.T_world_cam, box.corners)
            ends = list(itertools.product(*zip(own.min(axis=0), own.max(axis=0), strict=True)))
            assert np.allclose(corners, ends, atol=2e-6)
            u, v, _ = (view.K @ box.corners.T) / box.corners[:, 2]
            assert np.allclose(box.image, np.stack([u, v], axis=1))
        patch = view.patch()
        if patch is not None:
            moved = view.K[:2, 2] - patch.K[:2, 2]
            assert np.allclose(view.box().image - moved, patch.box().image)
            assert np.allclose(patch.cloud("world").points, view.cloud("world").points[in_patch(view, patch, moved)])


def in_patch(view, patch, moved):
    """Which points of the view's cloud are in a patch that begins at the column and row `moved`."""
    row, column = view.cloud().pixels.T - moved[::-1, None]
    height, width = patch.depth().shape
    return (row >= 0) & (row < height) & (column >= 0) & (column < width)


def test_a_corner_behind_the_camera_has_no_place_in_the_image(pairs):
    view = pairs[0].input
    row = {**view.regions[2], "T_cam_obj": np.eye(4).ravel()}  # the camera stands in the middle of the table
    inside = dataclasses.replace(view, regions={2: row})
    assert np.isnan(inside.box(2).image).all(axis=1).tolist() == [True, False] * 4


def test_partial_lies_on_complete_and_both_follow_from_the_seed(pairs):
    for pair in pairs:
        for number in objects_of(pair.input):
            for frame in ("object", "camera", "world"):
                partial, complete = pair.partial_and_complete(400, 7, frame=frame, region=number)
                mesh = pair.mesh(number).apply_transform(
                    {
                        "world": np.eye(4),
                        "camera": np.linalg.inv(pair.input.T_world_cam),
                        "object": np.linalg.inv(pair.T_world[number]),
                    }[frame]
                )
                assert partial.shape == complete.shape == (400, 3)
                assert (
                    off_surface(mesh, partial)[0].max() < 1.3 * UNIT_M and off_surface(mesh, complete)[0].max() < 1e-6
                )
            again, other = (pair.partial_and_complete(400, seed, frame=frame, region=number) for seed in (7, 8))
            assert np.array_equal(again, (partial, complete)) and not np.array_equal(other[0], partial)
        seen = pair.input.cloud().points
        few, many = (pair.partial_and_complete(count)[0] for count in (len(seen), 2 * len(seen)))
        assert len(np.unique(few, axis=0)) == len(seen) == len(np.unique(many, axis=0)) or len(many) > len(seen)
        assert np.array_equal(np.unique(few, axis=0), np.unique(seen, axis=0))


def test_complete_is_of_the_stored_samples_where_there_are_some(copy):
    (pair, *_) = open_dataset(copy).pairs()
    with pytest.raises(InputError, match=r"no samples of region 3 are stored: .*targets\.shape"):
        pair.samples()
    path = copy / "assets" / pair.category / f"{pair.instance_id}.npz"
    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    normals, colors, place = (
        np.zeros_like(points),
        np.zeros((10, 3), np.uint8),
        {"loc": np.zeros(3), "scale": np.float64(1)},
    )
    np.savez(path, surface_points=points, surface_normals=normals, surface_colors=colors, **place)
    assert np.array_equal(pair.samples()["surface_points"], points)
    complete = pair.partial_and_complete(10, frame="object")[1]
    assert np.allclose(complete[np.argsort(complete[:, 0])], points, atol=1e-9)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CorruptError, match=r"assets/.*\.npz cannot be read"):
        pair.samples()


def test_what_cannot_be_had_is_told_with_what_to_ask_for(files, pairs, copy):
    (plain, *_) = open_dataset(files.root).pairs()
    view = plain.input
    asks = {"normals": view.normals, "coordinates": view.coordinates, "albedo": view.albedo, "amodal": view.amodal}
    for target, ask in asks.items():
        with pytest.raises(
            InputError, match=rf"no image of kind '{target}', only rgb, depth, region: .*targets\.views names {target}"
        ):
            ask()
    with pytest.raises(InputError, match=r"targets\.views names covisible, of views beside the input's"):
        pairs[0].input.covisible()
    (alone,) = make_scene(
        {"name": "alone", "cameras": {"mirror": {"enabled": False}}, "images": {"projection": {"enabled": False}}}, 0
    )
    for told, call in (
        (r"targets\.views names layers", view.layers),
        (r"targets\.views names layers", view.thickness_m),
        (r"no image of kind 'normals', only rgb, depth$", plain.projected.normals),
        (r"no image of kind 'region', only rgb, depth$", lambda: plain.projected.cloud("world")),
        (
            r"region 9 is no object or table of this view; its object or tables are \[2, 3\]",
            lambda: view.cloud("camera", 9),
        ),
        (r"region None is no object or table", lambda: view.cloud("object", None)),
        (r"region 1 is no object or table", lambda: view.box(1)),
        (r"region 9 is no object or table", lambda: view.mesh(region=9)),
        (r"region 2 is no object of this view; its objects are \[3, 4, 5\]", lambda: pairs[-1].input.amodal(region=2)),
        (r"there is no frame 'robot': frames are object, camera and world", lambda: view.cloud("robot")),
        (r"pair 0 has no mirror view: .*cameras\.mirror\.enabled", alone.correspondence),
        (r"cameras\.mirror\.enabled", alone.flow),
        (r"n is 0", lambda: plain.partial_and_complete(0)),
        (r"region 9 is no object or table", lambda: plain.partial_and_complete(5, region=9)),
        (r"regions \[2, 3\], and no 9", lambda: plain.samples(region=9)),
    ):
        with pytest.raises(InputError, match=told):
            call()
