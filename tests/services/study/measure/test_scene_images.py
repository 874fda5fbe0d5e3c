"""Colour is held against other light by paths, and edges against the same light in finer sampling."""

from pathlib import Path

from services.study.measure import images as scene_images

from schemas.job.job import Job
from services.study.images import measure_colour
from services.study.knobs import apply, knobs_of, settings_of
from workers.assets.catalogue import open_catalogue
from workers.scene.context import open_worker


def test_four_samples_are_nearer_to_smooth_edges_than_one_and_flat_light_has_no_edges_to_compare(monkeypatch):
    monkeypatch.setattr(scene_images, "colour_truth_missing", lambda: "not here")
    job = apply(Job(name="t", seed=2024), {"check.raycast_share": 0.0})
    context = open_worker(job, open_catalogue(job.assets, Path(), tuple(job.categories)))
    settings, _ = settings_of(job, [knob for knob in knobs_of(job) if knob.name == "colour"])
    wanted = [setting for setting in settings if "path" not in setting.name]
    for scene_id in (0, 2):
        found = measure_colour(context, wanted, scene_id)
        assert found["colour=raster-4"]["edge_flip"] < 0.8 * found["the job"]["edge_flip"] < 0.1
        assert found["colour=flat"] == {}
