"""What a job switches off is not there, and nothing else changes: each switch from the job file to the merged files."""

import csv
import json

import pytest

from schemas.dataset.shard import Fingerprint
from schemas.errors import InputError, JobError
from schemas.job.job import Job
from services.bench.command import refuse_unmatched
from services.job.job_file import validate_job
from services.job.record import require_job
from services.merge.dataset_card import describe_dataset
from services.merge.merge import MergeResult, read_success
from services.read.contact_sheet import draw_sheet
from services.read.query import query
from services.read.replay import open_context, replay_scene
from tests.datasets import faults_of, images_of, make_dataset

ROLES = {"input", "aligned", "mirror", "projected"}

SWITCHES = {
    "depth camera": ({"cameras": {"depth": {"enabled": False}}}, {"aligned"}, ("aligned", "Aligned")),
    "projection": ({"images": {"projection": {"enabled": False}}}, {"projected"}, ("projected", "Projected")),
    "mirror": (
        {"cameras": {"mirror": {"enabled": False}}, "images": {"projection": {"enabled": False}}},
        {"mirror", "projected"},
        ("projected", "Projected"),
    ),
    "rgb": ({"render": {"rgb": False}}, set(), ("RGB",)),
}
"""What is switched off, the roles that go with it, and words that no file's name may have then."""


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("full"))


@pytest.fixture(scope="module", params=SWITCHES, ids=lambda name: name.replace(" ", "-"))
def reduced(request, tmp_path_factory):
    changes, roles, words = SWITCHES[request.param]
    return request.param, make_dataset(tmp_path_factory.mktemp("reduced"), **changes), roles, words


def lines_by_pose(store, name: str) -> dict[tuple[str, ...], str]:
    """Lines of a merged file by (pose id,), in cameras.csv by (pose id, role)."""
    lines = (store.root / name).read_text().splitlines()
    body = lines if name == "objects.dat" else lines[1:]
    key = {"camPoses.csv": (0,), "cameras.csv": (0, 2), "objects.dat": (0, 3)}[name]
    split = [line.split(" " if name == "objects.dat" else ",") for line in body]
    return {tuple(words[k] for k in key): line for words, line in zip(split, body, strict=True)}


def test_it_verifies_and_replays_to_the_byte(reduced):
    _, (store, _), _, _ = reduced
    assert faults_of(store) == []
    replayed = replay_scene(store, 1)
    assert replayed.same_stack and replayed.differences == ()


def test_its_images_are_gone_and_the_others_are_the_same_bytes(full, reduced):
    name, (store, _), roles, words = reduced
    before, after = images_of(full[0]), images_of(store)
    assert after and not [path for path in after if any(word in path for word in words)]
    if name == "mirror":  # rendered by the mirror camera: an odd id
        assert not [path for path in after if int(path.rpartition(".")[0][-5:]) % 2]
    assert after == {path: before[path] for path in after}
    rows = query(full[0], "select role, unnest(files).path as path from views").to_pylist()
    gone = {row["path"] for row in rows if row["role"] in roles or (name == "rgb" and "RGB" in row["path"])}
    assert before.keys() - after.keys() == gone


def test_its_rows_are_gone_and_the_others_say_the_same(full, reduced):
    _, (store, _), roles, _ = reduced
    sql = "select * exclude (files) from views order by pose_id, role"
    before, after = (query(one, sql).to_pylist() for one in (full[0], store))
    assert {row["role"] for row in after} == ROLES - roles
    assert after == [row for row in before if row["role"] not in roles]
    sql = "select * from objects order by pose_id, role, region_id"
    before, after = (query(one, sql).to_pylist() for one in (full[0], store))
    assert after == [row for row in before if row["role"] not in roles]


def test_the_articles_files_have_the_lines_of_the_cameras_that_are_there(full, reduced):
    name, (store, _), roles, _ = reduced
    before, after = (lines_by_pose(one, "cameras.csv") for one in (full[0], store))
    assert after == {key: line for key, line in before.items() if key[1] not in roles}
    for file in ("camPoses.csv", "objects.dat"):
        before, after = (lines_by_pose(one, file) for one in (full[0], store))
        odd_too = "mirror" not in roles
        assert after == {key: line for key, line in before.items() if odd_too or int(key[0]) % 2 == 0}
    if name == "mirror":
        with open(store.root / "camPoses.csv") as file:
            assert [int(row["id"]) for row in csv.DictReader(file)] == [0, 2]


def test_its_scenes_say_that_it_did_not_run(full, reduced):
    name, (store, _), _, _ = reduced
    effect = name.replace(" ", "_")
    for row in query(store, "select effects, skipped from scenes").to_pylist():
        assert effect not in row["effects"]
        assert any(skip["effect"] == effect and skip["why"].endswith("is false") for skip in row["skipped"])
    for row in query(full[0], "select effects from scenes").to_pylist():
        assert effect in row["effects"]


def test_an_image_that_is_switched_off_and_there_all_the_same_is_found(full, reduced):
    """A dataset whose job says one thing and whose rows say another does not verify."""
    _, (store, _), _, _ = reduced
    job, rightful = (store.root / "job.yaml"), (store.root / "job.yaml").read_text()
    job.write_text((full[0].root / "job.yaml").read_text())
    try:
        assert faults_of(store)
    finally:
        job.write_text(rightful)


def test_the_sheet_and_the_card_are_made_without_it(reduced):
    name, (store, digest), _, _ = reduced
    assert draw_sheet(store, 1).mode == "RGB"
    record, success = require_job(store), read_success(store)
    fingerprint = Fingerprint.model_validate_json(store.read("manifest/_fingerprint.json"))
    merged = MergeResult(digest, True, dict(success["scenes"]), dict(success["rows"]))
    card = describe_dataset(record, open_context(record).catalogue, merged, fingerprint)
    told = next(line for line in card.splitlines() if line.startswith("| views of each pair"))
    assert {
        "depth camera": "| input, mirror, projected |",
        "projection": "| input, aligned, mirror |",
        "mirror": "| input, aligned |",
        "rgb": "; without RGB |",
    }[name] in told


def test_d_z_is_told_without_a_mirror_camera(full, reduced):
    _, (store, _), _, _ = reduced
    sql = "select d_z_m from views where role = 'input' order by pose_id"
    assert query(store, sql).to_pylist() == query(full[0], sql).to_pylist()


def test_a_projection_without_a_mirror_camera_is_refused_with_the_remedy():
    with pytest.raises(JobError, match=r"set images\.projection\.enabled: false too"):
        validate_job({"name": "t", "cameras": {"mirror": {"enabled": False}}}, "t")


def test_an_effect_on_rgb_without_rgb_is_refused_naming_it():
    with pytest.raises(JobError, match=r"sensor\.rgb_noise"):
        validate_job({"name": "t", "render": {"rgb": False}, "sensor": {"rgb_noise": {}}}, "t")


@pytest.mark.parametrize("name", SWITCHES)
def test_the_benchmark_refuses_it_by_name(name):
    changes, *_ = SWITCHES[name]
    with pytest.raises(InputError, match="is off"):
        refuse_unmatched(validate_job({"name": "t", **json.loads(json.dumps(changes))}, "t"))
    refuse_unmatched(Job(name="t"))
