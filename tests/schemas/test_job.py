"""Jobs: names of categories, patterns of files, sizes of ranges, presets, captures, and which keys make a job the same."""

import math

import pytest
from pydantic import ValidationError

from schemas.job.assets import CATEGORIES, Assets, ProceduralSource, offered_by
from schemas.job.job import PATHS, PRESETS, Job, compare_jobs, differing_keys, job_digest, settings_digest, with_preset
from schemas.job.physics import Start
from schemas.job.views import Targets
from tests.datasets import overlaid

LIBRARY = {"source": "library", "folder": "/somewhere"}
BASE = {"name": "t", "assets": {"objects": [LIBRARY]}}
FOLDERS = {"name": "t", "captures": {"folders": ["a", "b", "c"]}}
SIMULATED = {"name": "t", "captures": {}}


def job(base: dict | None = None, **changes) -> Job:
    return Job.model_validate(overlaid(base or {"name": "t"}, changes))


# ------------------------------------------------------------------------------------------------ assets


def test_without_categories_a_job_has_all_that_its_sources_offer_once():
    assert tuple(job().categories) == CATEGORIES
    mixed = {"objects": [LIBRARY, {"source": "procedural"}, LIBRARY]}  # a library may offer anything until it is opened
    assert list(job(assets=mixed).categories) == list(CATEGORIES)
    assert job(assets={"objects": [LIBRARY]}, categories=["brick"]).categories == {"brick": 1.0}
    assert offered_by([{}, {"source": 3}, {"source": "library"}]) == ()


def test_a_name_that_cannot_be_is_refused_with_the_remedy():
    sources = {"objects": [{"source": "procedural"}]}
    for name, words in (
        ("mugg", "no source offers it; did you mean 'mug'[?] offered: bottle, camera"),
        ("zebra", "no source offers it; offered: bottle"),
        ("../x", "1 to 64 letters, digits, - and _"),
        ("a b", "1 to 64 letters"),
        ("\u202emug", "1 to 64 letters"),
        ("杯" * 65, "1 to 64 letters"),
        ("a\u0308", "composed"),
        ("", "letters, digits"),
        ("x" * 65, "1 to 64"),
        ("002", "write a letter too, such as n002"),
        ("table", "what objects stand on"),
        ("Manifest", "a folder of this name"),
    ):
        with pytest.raises(ValidationError, match=words) as refusal:
            job(assets=sources, categories=[name])
        assert "[A-Za-z" not in str(refusal.value)


# ------------------------------------------------------------------------------------------------ ranges, presets


def test_ranges_give_every_worker_one_and_take_ten_seconds_at_most():
    assert job(scenes=2, run={"range_size": 40}).range_size == 40
    for scenes in (1, 2, 31, 32, 64, 500, 10_000):
        assert math.ceil(scenes / job(scenes=scenes).range_size) >= min(scenes, 32)
    assert job(scenes=10**6).range_size == 16
    assert job(scenes=10**6, objects_per_scene=[1, 16]).range_size < 16
    piles = {"objects_per_scene": 8, "start": {"pose": "tumbled", "arrange": "pile"}}  # 1.7 s each
    assert job(scenes=16, **piles).range_size == 1
    assert 1 < job(scenes=10**6, **piles).range_size <= 10 / 1.7
    traced = [job(scenes=10**4, render={"tier": "pathtraced", "path_samples": n}).range_size for n in (4, 16, 256)]
    assert traced[0] > traced[1] >= traced[2] == 1
    assert job(SIMULATED).range_size == 1


def test_a_preset_fills_the_keys_that_the_job_does_not_give():
    given = {"preset": "exact", "render": {"samples": 1}}
    filled = with_preset(given)
    assert filled["render"] == {"samples": 1, "tier": "raster"}
    assert filled["physics"] == {"step_hz": PRESETS["singles"]["exact"]["physics.step_hz"]}
    assert given == {"preset": "exact", "render": {"samples": 1}}
    for name in ("unknown", 3, None, ["fast"]):
        assert with_preset({"preset": name}) == {"preset": name}
    assert with_preset({"physics": 3})["physics"] == 3


def test_a_scene_of_tier_pathtraced_has_longer_unless_the_job_says_how_long():
    traced = {"render": {"tier": "pathtraced"}}
    assert [job(**keys).run.scene_timeout_s for keys in ({}, traced)] == [120.0, 600.0]
    assert job(**traced, run={"scene_timeout_s": 5}).run.scene_timeout_s == 5.0
    assert job(FOLDERS, **traced).run.scene_timeout_s == 1800.0


# ------------------------------------------------------------------------------------------------ captures


def test_what_follows_from_captures_unless_the_job_says_otherwise():
    assert (job(FOLDERS).scenes, job(FOLDERS, scenes=2).stop_scene) == (3, 2)
    made = job(SIMULATED, pairs_per_scene=50)
    assert (made.pairs_per_scene, made.cameras.depth.enabled, made.scenes) == (50, False, 64)
    assert (made.run.range_size, made.run.scene_timeout_s) == (1, 1800.0)
    assert job(SIMULATED, run={"range_size": 4}).run.range_size == 4
    for base in (FOLDERS, SIMULATED):
        assert Job.model_validate(job(base).model_dump(mode="json")) == job(base)


def test_what_a_capture_cannot_have_is_refused_with_its_key():
    for changes, words in (
        ({"scenes": 4}, "3 folders"),
        ({"first_scene": 1, "scenes": 2}, "first_scene must be 0"),
        ({"cameras": {"depth": {"enabled": True}}}, "registered"),
        ({"objects_per_scene": [1, 3]}, "one object"),
        ({"sensor": {"depth_noise": {}}}, "captures.simulate"),
        ({"render": {"rgb": False}}, "render.rgb"),
        ({"captures": {"board": {"columns": 9}}}, "width_m is 0.6, and 9 markers with their gaps need"),
    ):
        with pytest.raises(ValidationError, match=words):
            job(FOLDERS, **changes)


# ------------------------------------------------------------------------------------------------ identity


def test_a_key_belongs_to_the_dataset_to_its_scenes_or_to_neither():
    for changes, same_dataset, same_scene in (
        ({"scenes": 7}, True, True),
        ({"run": {"workers": 3, "fingerprint": "record"}}, True, True),
        ({"assets": {"objects": [{**LIBRARY, "folder": "/elsewhere"}]}}, True, True),
        ({"name": "u"}, False, True),
        ({"first_scene": 4}, False, True),
        ({"output": {"layout": "tar"}}, False, True),
        ({"preset": "exact", "physics": {"step_hz": 960}, "render": {"samples": 1}}, True, True),
        ({"seed": 1}, False, False),
        ({"cameras": {"mirror": {"T_z_m": 1.4}}}, False, False),
        ({"sensor": {"rgb_noise": {}}}, False, False),
        ({"assets": {"objects": [{**LIBRARY, "diagonal_m": 2.0}]}}, False, False),
    ):
        before, after = job(BASE), job(BASE, **changes)
        assert (job_digest(before, "c") == job_digest(after, "c")) is same_dataset, changes
        assert (settings_digest(before, "c") == settings_digest(after, "c")) is same_scene, changes
        assert (compare_jobs(before, after) == []) is same_dataset, changes
    assert job_digest(job(), "c") != job_digest(job(), "d") and settings_digest(job(), "c") != settings_digest(
        job(), "d"
    )
    differing = compare_jobs(job(), job(seed=2, start={"pose": "tumbled"}))
    assert differing == [("seed", 0, 2), ("start.pose", "upright", "tumbled")]


def test_settings_of_captures_belong_to_the_dataset_and_paths_do_not():
    before, moved = job(FOLDERS), job(FOLDERS, captures={"folders": ["x/a", "x/b", "x/c"]})
    assert compare_jobs(before, moved) == [] and job_digest(before, "c") == job_digest(moved, "c")
    finer = job(FOLDERS, captures={"fusion": {"voxel_m": 0.001}})
    assert compare_jobs(before, finer) == [("captures.fusion.voxel_m", 0.002, 0.001)]
    assert settings_digest(before, "c") != settings_digest(finer, "c")


class _LongerStart(Start):
    spin: float = 1.0


class _LongerSource(ProceduralSource):
    gloss: float = 0.5


class _LongerAssets(Assets):
    objects: tuple[_LongerSource, ...] = (_LongerSource(source="procedural"),)


class _LongerJob(Job):
    start: _LongerStart = _LongerStart()
    assets: _LongerAssets = _LongerAssets()
    other_targets: Targets | None = None
    views: tuple[int, ...] = (1, 2)


def test_a_key_that_a_later_version_adds_leaves_the_digests_of_older_jobs_and_counts_where_it_is_set():
    keys = {"name": "t", "start": {"pose": "tumbled"}, "assets": {"objects": [{"source": "procedural", "seed": 3}]}}
    older, newer = (kind.model_validate(keys) for kind in (Job, _LongerJob))
    for digest in (job_digest, settings_digest):
        assert digest(newer, "c") == digest(older, "c")
        for changes in (
            {"start": {"spin": 2.0}},
            {"views": [1]},
            {"other_targets": {}},
            {"assets": {"objects": [{"source": "procedural", "seed": 3, "gloss": 0.4}]}},
        ):
            assert digest(_LongerJob.model_validate(overlaid(keys, changes)), "c") != digest(older, "c"), changes
    assert differing_keys(older) == {**keys}


def test_a_digest_is_that_of_what_differs_from_the_defaults_of_the_keys_whatever_filled_them():
    exact = job(preset="exact")
    assert differing_keys(exact)["physics"] == {"step_hz": 1920} and differing_keys(job(seed=0)) == {"name": "t"}
    assert job_digest(exact, "c") == job_digest(job(physics={"step_hz": 1920}, render={"samples": 4}), "c")
    assert job_digest(exact, "c") != job_digest(job(), "c")
    noisy = job(sensor={"depth_noise": {}})
    assert differing_keys(noisy)["sensor"] == {"depth_noise": {}}, "a branch that is there differs from none"
    sources = differing_keys(job(BASE), PATHS)["assets"]["objects"]
    assert sources == [{"source": "library"}], "the kind of a source stays, the path of its folder does not"
