"""Further cameras and studio scenes: labels by cast rays, disparity, symmetry, sizes, and what one entry leaves of another."""

import dataclasses
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from schemas.scene.scene import ScenePlan
from services.read.audit import verify_independently
from services.read.dataset_reader import find_scene
from tests.datasets import faults_of, make_dataset, overlaid
from tests.effects.scenes import Setting, make
from tests.kit.shapes import asset_of, box
from workers.geometry.camera import look_at
from workers.geometry.hull import hull_of
from workers.scene.studio import scaled_to

BAND = [0.35, 1.3]
ABOVE: dict[str, dict[str, Any]] = {
    "ring": {
        "ring": {"count": 3, "inclination_rad": BAND, "start": "input", "radius_m": [0.9, 1.5]},
        "roll_deg": [-90, 90],
    },
    **{
        pattern: {"sphere": {"count": 3, "pattern": pattern, "inclination_rad": BAND}}
        for pattern in ("hammersley", "fibonacci", "trellis")
    },
    **{
        pattern: {"sphere": {"count": 3, "pattern": pattern, "inclination_rad": BAND, "radius_m": [1.0, 2.0]}}
        for pattern in ("uniform", "cube")
    },
    "stereo": {"beside": "input", "offset_m": [0.06, 0.0, 0.0]},
    "poses": {"poses": "poses.json"},
    "syncdreamer": {"preset": "syncdreamer"},
}
"""Entries of each kind, all above a table."""
AROUND = (
    ABOVE
    | {name: {"preset": name} for name in ("zero123", "zero123plus", "lrm", "trellis")}
    | {"everywhere": {"sphere": {"count": 4, "pattern": "fibonacci"}}}
)
SCENES = [2, pytest.param(100, marks=pytest.mark.slow)]


def write_poses(folder: Path) -> str:
    """A table of two poses of the world, above the table's top and aside of its middle."""
    poses = [look_at(np.array([x, 0.9, 1.6]), np.array([0.0, 0.05, 0.6])).ravel().tolist() for x in (-0.4, 0.7)]
    path = folder / "poses.json"
    path.write_text(json.dumps([{"T_world_cam": T} for T in poses]))
    return str(path)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("scenes", SCENES)
@pytest.mark.parametrize(("scene", "kinds"), [("tabletop", ABOVE), ("studio", AROUND)])
def test_every_view_of_every_kind_shows_what_rays_meet_and_verifies(tmp_path, scene, kinds, scenes):
    """No failures: the check of every scene by cast rays, which a wrong label fails, is one of those that make it a failure."""
    poses = write_poses(tmp_path)
    more = [
        entry | {"name": f"cam-{kind}"} | ({"poses": poses} if kind == "poses" else {}) for kind, entry in kinds.items()
    ]
    sensor = {"width": 64, "height": 48, "fx": 52.5, "fy": 52.5, "cx": 32.0, "cy": 24.0}
    job = {"scene": scene, "scenes": scenes, "check": {"raycast_share": 1.0}, "images": {"depth_range_m": [0.05, 13.0]}}
    store, _ = make_dataset(tmp_path / "out", **job, cameras={"more": more, "sensor": sensor})
    stored = [find_scene(store, scene_id) for scene_id in range(scenes)]
    assert not [row for each in stored for row in each.rows["failures"]]
    assert all(row["raycast_checked"] for each in stored for row in each.rows["scenes"])
    assert faults_of(store) == []
    verdict = verify_independently(store, min(scenes, 4), lambda _: None)
    assert verdict.faults == []
    assert {view["role"] for view in stored[0].rows["views"]} >= {entry["name"] for entry in more}


def alone(mesh: trimesh.Trimesh, **changes: Any) -> Setting:
    """A studio scene of this mesh."""

    def edit(plan: ScenePlan) -> ScenePlan:
        asset = asset_of(mesh)
        start = dataclasses.replace(plan.objects[0], asset=asset, hull=hull_of(asset.shape))
        return dataclasses.replace(plan, objects=(start,))

    return Setting(overlaid({"scene": "studio", "images": {"depth_range_m": [0.05, 13.0]}}, changes), edit)


UNITS = 65_000.0


def test_disparity_of_a_stereo_pair_is_the_distance_between_images_of_a_point():
    """fx b / z is linear on a plane's image: between two pixels of the other view it is what lies between theirs."""
    more = [{"name": "right", "beside": "input", "offset_m": [0.06, 0.0, 0.0]}]
    images = {"depth_units_per_m": UNITS, "depth_range_m": [0.05, 1.0]}
    made = make(alone(box(0.2, 0.15, 0.2), cameras={"more": more}, images=images))
    (left, right) = (view for _, view in made.scene.views())
    k, worst, count = left.camera.intrinsics, 0.0, 0
    disparity = [np.where(v.depth > 0, k.fx * 0.06 * UNITS / np.maximum(v.depth, 1), np.nan) for v in (left, right)]
    for row, column in np.argwhere(left.region > 0):
        u = column - disparity[0][row, column]
        first, share = math.floor(u), u - math.floor(u)
        if not 1 <= first < k.width - 3:
            continue
        around = disparity[1][row, first - 1 : first + 3]
        if np.isnan(around).any() or np.abs(np.diff(around, n=2)).max() > 5e-4:
            continue  # an edge of the box
        between = (1.0 - share) * around[1] + share * around[2]
        worst, count = max(worst, abs(between - disparity[0][row, column])), count + 1
    assert count > 500 and worst < 1e-3


def test_views_of_a_ring_are_alike_for_a_body_of_revolution():
    mesh = trimesh.creation.cylinder(radius=0.2, height=0.5, sections=24)
    more = [{"name": "around", "ring": {"count": 8, "inclination_rad": 0.5, "radius_m": 1.2}}]
    made = make(alone(mesh, cameras={"more": more}, render={"tier": "flat"}))
    views = [view for _, view in made.scene.views() if view.role == "around"]
    first = views[0]
    assert len(views) == 8 and np.count_nonzero(first.region) > 1000
    for view in views[1:]:
        assert np.count_nonzero(view.region != first.region) <= 2  # roundings at the outline
        both = (view.region > 0) & (first.region > 0)
        assert np.abs(view.depth[both].astype(int) - first.depth[both].astype(int)).max() <= 1
    assert not np.array_equal(first.camera.T_world_cam, views[1].camera.T_world_cam)


@pytest.mark.parametrize("scale", ["unit_sphere", "unit_cube"])
def test_a_scaled_object_has_just_that_size_in_its_file_and_its_row(tmp_path, scale):
    stored = {}
    for kind in ("metric", scale):
        studio = {"scale": kind, "size_m": 0.7} if kind != "metric" else {}
        store, _ = make_dataset(tmp_path / kind, scene="studio", scenes=1, categories=["mug"], studio=studio)
        rows = find_scene(store, 0).rows
        mesh = trimesh.load_mesh(io.BytesIO(store.read(f"assets/mug/{rows['scenes'][0]['instance_id']}.glb")), "glb")
        stored[kind] = (
            np.asarray(mesh.vertices),
            rows["scenes"][0]["object_scale"],
            rows["scenes"][0]["bodies"][0]["mass_kg"],
        )
    (before, scale_before, mass_before), (points, scale_now, mass_now) = stored["metric"], stored[scale]
    reach = np.linalg.norm(points, axis=1).max() if scale == "unit_sphere" else np.ptp(points, axis=0).max()
    assert reach == pytest.approx(0.7, rel=1e-6)
    factor = scale_now / scale_before
    assert np.allclose(points, factor * before, rtol=0.0, atol=1e-6)
    assert mass_now == pytest.approx(mass_before * factor**3, rel=1e-9)
    T, asset = np.eye(4), asset_of(box(0.1, 0.2, 0.4))
    T[:3, 3] = 1.0, 2.0, 3.0
    grown = scaled_to(dataclasses.replace(asset, T_source_to_object=T), make_studio("unit_cube"))
    assert (grown.shape.vertices == 2.5 * asset.shape.vertices).all() and grown.volume_m3 == pytest.approx(0.125)
    assert (grown.T_source_to_object[:3, 3] == [2.5, 5.0, 7.5]).all() and grown.scale == 2.5


def make_studio(scale: str) -> Any:
    """The branch `studio` of a job."""
    return Setting({"scene": "studio", "studio": {"scale": scale}}).job.studio


def test_entries_change_no_byte_of_one_another_or_of_pairs():
    entries = [
        {"name": "around", "ring": {"count": 2, "inclination_rad": BAND, "radius_m": [0.9, 1.5]}, "roll_deg": [0, 90]},
        {"name": "over", "sphere": {"count": 2, "pattern": "uniform", "inclination_rad": BAND}},
        {"name": "right", "beside": "mirror", "offset_m": [0.06, 0.0, 0.0]},
    ]
    noisy = {"sensor": {"depth_noise": {}, "rgb_noise": {}}}
    none, all_of_them, turned = (
        make(Setting({**noisy, "cameras": {"more": more}})).files for more in ([], entries, entries[::-1])
    )
    assert all_of_them == turned and none.items() <= all_of_them.items()
    for entry in entries:
        single = make(Setting({**noisy, "cameras": {"more": [entry]}})).files
        assert single.items() <= all_of_them.items()
        assert any(f"_{entry['name']}_" in path for path in single)
