"""From a job file to a `Job`: every fault by file, key, value and what is allowed."""

from pathlib import Path

import pytest

from schemas.errors import JobError
from schemas.job.job import Job
from services.job.read import load_job

ROOT = Path(__file__).resolve().parents[3]


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "job.yaml"
    path.write_text(text)
    return path


def fault(tmp_path: Path, text: str, *changes: str) -> str:
    path = write(tmp_path, text)
    with pytest.raises(JobError) as caught:
        load_job(path, changes)
    assert caught.value.exit_code == 2
    assert "Traceback" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("path", sorted((ROOT / "deploy" / "jobs").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_example_is_a_job(path):
    assert load_job(path).name == path.stem


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name: a\nscens: 3", ["scens", "did you mean 'scenes'"]),
        ("name: a\nscenes: -3", ["scenes", "-3", "greater than or equal to 1"]),
        ("name: a\nphysics: {step_hz: abc}", ["physics.step_hz", "'abc'", "integer"]),
        ("name: a\nstart: {clearance_m: [0.3, 0.1]}", ["start.clearance_m", "0.3", "empty"]),
        ("name: a\ncategories: [mug, sofa]", ["categories.sofa", "'bottle'", "'mug'"]),
        ("name: a\ncategories: [mug, mug]", ["categories", "twice"]),
        ("name: a\ncategories: []", ["categories", "at least 1"]),
        ("name: a\nassets: {objects: [{source: nowhere}]}", ["assets.objects.0", "nowhere", "'procedural'"]),
        ("name: a\nassets: {objects: [{source: urdf}]}", ["assets.objects.0.folder", "missing"]),
        ("name: a\nassets: {split: {train: 0.5}}", ["assets.split", "0.7"]),
        ("name: a\nimages: {depth_units_per_m: 10000}", ["images", "80000", "65535"]),
        ("name: a\nimages: {projection: {splat: 4}}", ["images.projection.splat", "4", "even"]),
        ("name: a\nobjects_per_scene: 21", ["objects_per_scene", "21", "from 1 to 20"]),
        ("name: a\nobjects_per_scene: 0", ["objects_per_scene", "0", "from 1 to 20"]),
        ("name: a\nobjects_per_scene: [2, 1]", ["objects_per_scene", "[2, 1]", "empty"]),
        ("name: a\nobjects_per_scene: [1, 2.5]", ["objects_per_scene", "2.5", "[low, high]"]),
        ("name: a\nobjects_per_scene: true", ["objects_per_scene", "True", "whole number"]),
        ("name: a\nobjects_per_scene: many", ["objects_per_scene", "'many'", "whole number"]),
        ("name: a/b", ["name", "a/b"]),
        ("name: a\nverso: 2", ["verso", "2", "newer"]),
        ("name: a\nseed: 1\nseed: 2", ["line 3", "'seed'", "twice"]),
        ("scenes: 3", ["name", "missing"]),
        ("- a\n- b", ["list", "keys and values"]),
        ("", ["nothing"]),
        ("name: [", ["not YAML"]),
        ("name: a\nphysics: {max_settle_s: .inf}", ["physics.max_settle_s", "finite"]),
        ("name: a\n3: b", ["line 2", "3", "not a word"]),
    ],
)
def test_a_fault_is_told_by_file_key_value_and_remedy(tmp_path, text, words):
    message = fault(tmp_path, text)
    assert "job.yaml" in message
    assert all(word in message for word in words), message


def test_several_faults_are_told_at_once(tmp_path):
    assert len(fault(tmp_path, "name: a\nscenes: 0\nseed: -1\nfoo: 1").splitlines()) == 3


def test_a_missing_file_names_the_examples(tmp_path):
    with pytest.raises(JobError, match="deploy/jobs"):
        load_job(tmp_path / "none.yaml")


def test_changes_reach_every_depth_and_positions_in_lists(tmp_path):
    path = write(tmp_path, "name: a\nassets: {objects: [{source: procedural}]}")
    job = load_job(path, ["physics.rest.window_s=0.5", "assets.objects.0.weight=3", "categories=[mug]", "scenes=9"])
    assert (job.physics.rest.window_s, job.assets.objects[0].weight, dict(job.categories), job.scenes) == (
        0.5, 3.0, {"mug": 1.0}, 9,
    )  # fmt: skip


@pytest.mark.parametrize(
    "change", ["nonsense", "=3", "name.deeper=3", "assets.objects.7.weight=1", "scenes=[", "nokey=1"]
)
def test_a_change_that_cannot_be_made_is_told(tmp_path, change):
    fault(tmp_path, "name: a\nassets: {objects: [{source: procedural}]}", change)


def test_a_job_with_all_defaults_is_the_articles():
    job = Job(name="a")
    sensor, orbit = job.cameras.sensor, job.cameras.orbit
    assert (sensor.width, sensor.height, sensor.fx, sensor.fy, sensor.cx, sensor.cy) == (640, 480, 525, 525, 320, 240)
    assert (*orbit.inclination_rad, orbit.radius_m, job.cameras.mirror.T_z_m) == (0.7, 0.9, 2.5, 1.3)
    assert job.cameras.depth.offset_m == (-0.051, 0.001, -0.001)
    assert (job.images.patch.width, job.images.patch.height, job.images.depth_units_per_m) == (128, 96, 5000)
    assert job.start.offset_m == (-0.25, 0.25)
    assert len(job.categories) == 8


@pytest.mark.parametrize(
    ("text", "ends", "told"), [("3", (3, 3), 3), ("[1, 5]", (1, 5), [1, 5]), ("[4, 4]", (4, 4), 4)]
)
def test_a_count_of_objects_is_a_number_or_a_range_and_is_written_as_it_was(tmp_path, text, ends, told):
    job = load_job(write(tmp_path, f"name: a\nobjects_per_scene: {text}"))
    assert job.objects_per_scene == ends
    dumped = job.model_dump(mode="json")
    assert dumped["objects_per_scene"] == told
    assert Job.model_validate(dumped) == job
