"""Image targets of shapes whose faces are known: a box in a box, a sphere, a tile, a floor that reaches behind the camera."""

import numpy as np
import pytest
import trimesh

from schemas.base import frozen_array
from schemas.job.job import Job
from schemas.job.views import Targets
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import Material, Part, Shape
from schemas.scene.view import Camera, Intrinsics
from tests.kit.shapes import box, shape_of
from workers.geometry.camera import look_at
from workers.scene.context import Stopwatch
from workers.scene.targets import draw_targets

SIZE = (120, 160)
CAMERA = Camera(
    Intrinsics(width=160, height=120, fx=140.0, fy=140.0, cx=80.0, cy=60.0),
    frozen_array(look_at(np.array([0.5, 0.3, 0.4]), np.zeros(3))),
)
NAMES = ("normals", "coordinates", "albedo", "amodal", "layers")


def placed(region: int, shape: Shape, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Placed:
    T = np.eye(4)
    T[:3, 3] = at
    return Placed(region, shape, frozen_array(T))


def draw(*things: Placed, region: np.ndarray | None = None, names=NAMES, **targets) -> dict[str, np.ndarray]:
    """The targets of things; without a mask, of that of the nearest surfaces."""
    job = Job(name="t", targets=Targets(views=names, **targets))
    plan = EffectPlan(names, {})
    if region is None:
        region = draw(*things, region=np.zeros(SIZE, np.uint8))["layer1_region"]
    return draw_targets(things, CAMERA, region, job, plan, Stopwatch())


def rays() -> np.ndarray:
    """[H, W, 3]: through pixel centres, z = 1, the camera's frame."""
    k = CAMERA.intrinsics
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.stack([(column + 0.5 - k.cx) / k.fx, (row + 0.5 - k.cy) / k.fy, np.ones(SIZE)], axis=-1)


def slabs(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(z where rays enter, z where they leave) a box about the origin with these half sides; enter > leave where they miss."""
    T = np.linalg.inv(CAMERA.T_world_cam)
    direction, origin = rays() @ T[:3, :3], CAMERA.T_world_cam[:3, 3]
    ends = np.stack([(-half - origin) / direction, (half - origin) / direction])
    return ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)


def test_layers_are_the_walls_of_a_box_in_a_box_from_the_front_and_back_is_the_last():
    outer, inner = np.array([0.06, 0.05, 0.04]), np.array([0.03, 0.02, 0.02])
    drawn = draw(placed(3, shape_of(box(*(2 * outer)), box(*(2 * inner)))), layers=3)
    (near, far), (near2, far2) = slabs(outer), slabs(inner)
    inside, twice = far - near > 1e-3, far2 - near2 > 1e-3
    certain = (np.abs(far - near) > 1e-3) & (np.abs(far2 - near2) > 1e-3)
    expected = [near, np.where(twice, near2, far), np.where(twice, far2, np.nan)]
    for n, z in enumerate(expected, start=1):
        there = inside & ~np.isnan(z)
        assert np.array_equal(drawn[f"layer{n}"][certain] > 0, there[certain])
        assert np.abs(drawn[f"layer{n}"] - z * 5000.0)[certain & there].max() <= 0.5 + 1e-6
        assert np.array_equal(drawn[f"layer{n}_region"] == 3, drawn[f"layer{n}"] > 0)
    assert np.abs(drawn["back"] - far * 5000.0)[certain & inside].max() <= 0.5 + 1e-6 and "layer4" not in drawn


def test_normals_point_at_the_camera_and_coordinates_are_the_points_of_a_ball():
    ball = trimesh.creation.icosphere(5, 0.05)
    drawn = draw(placed(4, shape_of(ball), (0.02, 0.0, 0.01)))
    seen = drawn["layer1_region"] == 4
    points = drawn["coordinates"][seen] / 65535.0
    scale = np.linalg.norm(ball.extents)
    places = points * scale - scale / 2 + ball.bounds.mean(axis=0)
    assert np.abs(np.linalg.norm(places, axis=1) - 0.05).max() < 2e-4  # within the chords of its faces
    world = places + np.array([0.02, 0.0, 0.01])
    camera = (world - CAMERA.T_world_cam[:3, 3]) @ CAMERA.T_world_cam[:3, :3]
    assert np.abs(camera / camera[:, 2:] - rays()[seen]).max() < 1e-4
    normals = drawn["normals"][seen] / 65535.0 * 2.0 - 1.0
    assert np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() < 1e-4 and ((normals * camera).sum(axis=1) < 0.0).all()
    outward = places / np.linalg.norm(places, axis=1, keepdims=True) @ CAMERA.T_world_cam[:3, :3]
    assert np.degrees(np.linalg.norm(normals - outward, axis=1)).max() < 3.0
    assert not drawn["normals"][~seen].any() and not drawn["coordinates"][~seen].any()
    vertex_normals = frozen_array(ball.vertices / 0.05)
    part = Part("ball", frozen_array(ball.vertices), frozen_array(ball.faces, np.int32), normals=vertex_normals)
    smooth = draw(placed(4, Shape((part,)), (0.02, 0.0, 0.01)), smooth=True)["normals"][seen] / 65535.0 * 2.0 - 1.0
    assert np.degrees(np.linalg.norm(smooth - outward, axis=1)).max() < 0.02


def test_silhouettes_are_whole_behind_what_hides_them_one_for_each_object_in_order():
    behind, before = (
        placed(3, shape_of(box(0.08, 0.08, 0.08))),
        placed(4, shape_of(box(0.04, 0.04, 0.04)), (0.1, 0.06, 0.08)),
    )
    together, alone = draw(behind, before), draw(behind)
    assert together["amodal"].shape == (2, *SIZE)
    assert np.array_equal(together["amodal"][0], alone["amodal"][0])
    seen, whole = together["layer1_region"] == 3, together["amodal"][0] > 0
    assert seen.sum() < 0.9 * whole.sum() and (whole | ~seen).all()


def test_albedo_is_the_texture_bilinear_in_linear_light_upright_and_repeated():
    texture = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    corners = np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]])
    uv = corners[:, :2] * 10.0  # the texture twice along each side
    material = Material(base_color=(1.0, 1.0, 1.0, 1.0), texture=texture)
    faces = frozen_array(np.array([[0, 1, 2], [0, 2, 3]]), np.int32)
    tile = placed(3, Shape((Part("tile", frozen_array(corners), faces, material, uv=frozen_array(uv)),)))
    drawn = draw(tile)
    seen = np.argwhere(drawn["layer1_region"] == 3)
    direction, origin = rays() @ CAMERA.T_world_cam[:3, :3].T, CAMERA.T_world_cam[:3, 3]
    for row, column in seen[:: len(seen) // 40]:
        ray = direction[row, column]
        u, v = (origin - origin[2] / ray[2] * ray)[:2] * 10.0
        x, y = u * 2 - 0.5, (1 - v) * 2 - 0.5
        total = np.zeros(3)
        for i in (0, 1):
            for j in (0, 1):
                share = (1 - abs(x - np.floor(x) - i)) * (1 - abs(y - np.floor(y) - j))
                total += share * (texture[int(np.floor(y) + j) % 2, int(np.floor(x) + i) % 2] / 255.0)
        code = np.where(total <= 0.0031308, 12.92 * total, 1.055 * total ** (1 / 2.4) - 0.055) * 255.0
        assert np.abs(drawn["albedo"][row, column] - code).max() <= 0.7


@pytest.mark.parametrize("side_m", [0.4, 40.0])
def test_what_reaches_behind_the_camera_is_cut_at_the_near_plane_and_has_its_normal_everywhere(side_m):
    floor = placed(1, shape_of(box(side_m, side_m, 0.01, (0, 0, -0.005))))
    T = np.linalg.inv(CAMERA.T_world_cam)
    z = -CAMERA.T_world_cam[2, 3] / (rays() @ CAMERA.T_world_cam[2, :3])
    hit = CAMERA.T_world_cam[:3, 3] + z[..., None] * (rays() @ CAMERA.T_world_cam[:3, :3].T)
    on_top = (np.abs(hit[..., :2]) < side_m / 2 - 0.01).all(axis=-1) & (z > 0)
    drawn = draw(floor, region=np.where(on_top, 1, 0).astype(np.uint8), names=("normals",))
    expected = np.rint((T[:3, 2] + 1.0) / 2.0 * 65535.0)
    assert on_top.sum() > 500 and np.abs(drawn["normals"][on_top] - expected).max() <= 1.0
