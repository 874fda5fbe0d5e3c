"""The package `datasets` goes to no network, and writes nothing into the user's cache. Datasets with every target."""

import os
import tempfile

import numpy as np
import pytest
import trimesh

from schemas.dataset.layout import samples_path
from tests.datasets import make_dataset
from workers.store.local import LocalStore

FOLDER = tempfile.TemporaryDirectory(prefix="verso-tests-hf-")
# Read when it is imported.
os.environ.update(HF_HUB_OFFLINE="1", HF_HUB_DISABLE_TELEMETRY="1", HF_HOME=FOLDER.name)

IMAGES = {"views": ["normals", "coordinates", "albedo", "covisible", "amodal", "layers"], "layers": 2}
SENSOR = {"width": 320, "height": 240, "fx": 262.5, "fy": 262.5, "cx": 160.0, "cy": 120.0}
SHAPED = {
    "scenes": 3,
    "categories": ["box", "can"],
    "seed": 3,
    "cameras": {"sensor": SENSOR},
    "run": {"range_size": 2},
    "targets": {**IMAGES, "shape": ["surface", "volume"], "points": 20_000},
}

STUDIO = {
    "scenes": 3,
    "categories": ["box", "mug"],
    "seed": 3,
    "scene": "studio",
    "studio": {"scale": "unit_cube", "size_m": 2.0},
    "start": {"pose": "upright"},
    "cameras": {
        "sensor": {"width": 96, "height": 96, "fx": 100.0, "fy": 100.0, "cx": 48.0, "cy": 48.0},
        "more": [
            {
                "name": "around",
                "ring": {"count": 4, "inclination_rad": [-0.3, 0.8], "radius_m": 4.0},
                "roll_deg": [-20, 20],
            },
            {"name": "near", "sphere": {"count": 2, "radius_m": 3.5}, "fov_deg": 60.0},
            {"name": "right", "beside": "input", "offset_m": [0.25, 0.0, 0.0]},
            {"name": "left", "beside": "input", "offset_m": [-0.125, 0.0, 0.0]},
        ],
    },
    "targets": {"views": ["normals"]},
    "run": {"range_size": 2},
}


@pytest.fixture(scope="session")
def studio(tmp_path_factory) -> LocalStore:
    """Three objects alone, each with a ring, two views of another lens, and cameras left and right of the input camera."""
    return make_dataset(tmp_path_factory.mktemp("studio"), **STUDIO)[0]


@pytest.fixture(scope="session")
def studio_tars(tmp_path_factory) -> LocalStore:
    """The same in tars."""
    return make_dataset(tmp_path_factory.mktemp("studio"), output={"layout": "tar"}, **STUDIO)[0]


@pytest.fixture(scope="session")
def shaped(tmp_path_factory) -> LocalStore:
    """Three finished scenes of one object each, with image targets and shape targets."""
    return with_samples(make_dataset(tmp_path_factory.mktemp("shaped"), **SHAPED)[0])


@pytest.fixture(scope="session")
def shaped_tars(tmp_path_factory) -> LocalStore:
    """The same in tars."""
    return with_samples(make_dataset(tmp_path_factory.mktemp("tars"), output={"layout": "tar"}, **SHAPED)[0])


@pytest.fixture(scope="session")
def heap(tmp_path_factory) -> LocalStore:
    """One finished scene of three objects that hide one another, with image targets and shape targets."""
    changes = {"scenes": 1, "objects_per_scene": 3, "categories": ["box", "camera", "bottle"]}
    asked = {"start": {"offset_m": [-0.12, 0.12]}, "cameras": SHAPED["cameras"], "targets": SHAPED["targets"]}
    return with_samples(make_dataset(tmp_path_factory.mktemp("heap"), seed=2, **changes, **asked)[0])


def with_samples(store: LocalStore) -> LocalStore:
    """Writes the samples of every stored shape that has none, drawn by trimesh, as docs/dataset.md describes the file."""
    rng = np.random.default_rng(5)
    for path in store.root.glob("assets/*/*.glb"):
        target = store.root / samples_path(path.parent.name, path.stem)
        if target.exists():
            continue
        mesh = trimesh.load_scene(path, process=False).to_mesh()
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        points, faces = trimesh.sample.sample_surface(mesh, 20_000, seed=7)[:2]
        low, high = mesh.bounds
        spread = (low + high) / 2 + 1.05 * (high - low) * (rng.random((2000, 3)) - 0.5)
        space = np.concatenate([spread, points[:2000] + 0.01 * np.linalg.norm(high - low) * rng.normal(size=(2000, 3))])
        inside = mesh.contains(space.astype(np.float32))
        np.savez(
            target,
            surface_points=points.astype(np.float32),
            surface_normals=mesh.face_normals[faces].astype(np.float32),
            surface_colors=np.zeros((20_000, 3), np.uint8),
            volume_points=space.astype(np.float32),
            volume_distance=np.where(inside, -1, 1).astype(np.float32),
            volume_occupancy=inside.astype(np.uint8),
            loc=(low + high) / 2,
            scale=np.float64((high - low).max()),
        )
    return store
