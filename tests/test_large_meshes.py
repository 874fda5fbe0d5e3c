"""Scenes of meshes with millions of faces, made by the whole pipeline."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from schemas.job.job import Job
from schemas.scene.shape import REGION_FIRST_OBJECT, Part, Shape
from tests.kit.shapes import asset_of
from tests.workers.assets.libraries import library_of
from workers.assets.builtin.solid import circle, lathe
from workers.assets.catalogue import open_catalogue
from workers.assets.glb import asset_glb
from workers.render.raster.gbuffer import shared_renderer
from workers.scene.context import WorkerContext
from workers.scene.make_scene import make_scene
from workers.stopwatch import Stopwatch

FACETS = 1000


def fine_egg() -> Part:
    """An egg of two million faces with a flat base, 100 mm high and as wide."""
    half = circle(4 * FACETS)[3 * FACETS :]
    half = half[half[:, 1] > -0.9]
    arc = np.concatenate([half, circle(4 * FACETS)[:FACETS]])
    profile = np.concatenate([[[0.0, arc[0, 1]]], arc, [[0.0, 1.0]]]) * 0.05
    egg = lathe(profile, [0] * (len(profile) - 1), FACETS)
    return Part("egg", egg.vertices, egg.faces.astype(np.int32))


def write_part(part: Part, path: Path) -> float:
    """Writes the part as GLB or OBJ and returns its volume."""
    if path.suffix == ".glb":
        path.write_bytes(asset_glb(replace(asset_of(trimesh.creation.box((1, 1, 1))), shape=Shape((part,)))))
    else:
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in part.vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (part.faces + 1).tolist()]
        path.write_text("\n".join(lines) + "\n")
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_a_mesh_of_two_million_faces_makes_a_scene_within_the_time_that_a_scene_may_take(tmp_path, suffix):
    part = fine_egg()
    assert len(part.faces) > 2_000_000
    volume = write_part(part, tmp_path / f"egg.{suffix}")
    source = library_of(tmp_path)
    job = Job.model_validate({"name": "t", "categories": ["mug"], "assets": {"objects": [source]}})
    catalogue = open_catalogue(job.assets, tmp_path, ("mug",))
    stopwatch = Stopwatch()
    scene = make_scene(WorkerContext(job, catalogue, shared_renderer(), "t"), 0, stopwatch)
    asset = scene.plan.objects[0].asset
    assert asset.watertight and asset.notes == ()
    assert asset.volume_m3 == pytest.approx(volume, rel=1e-5)
    assert scene.settled[0].penetration_mm < 1e-6 and scene.settled[0].hover_gap_mm < 1e-6
    first = scene.pairs[0].input
    label = next(label for label in first.labels if label.region_id == REGION_FIRST_OBJECT)
    # A ball of 100 mm at 2.5 m is some 525 * 0.1 / 2.5 = 21 pixels across.
    assert label.pixels == pytest.approx(np.pi / 4 * 21**2, rel=0.25)
    assert sum(stopwatch.seconds.values()) < job.run.scene_timeout_s
