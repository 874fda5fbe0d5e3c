"""From a job file to a `Job`: every fault by file, key, value and what is allowed."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.errors import JobError
from schemas.job.job import Job
from services.job.job_file import describe_fault, load_job, pack_job
from services.job.packed import MARK, MOST_CHARACTERS, is_packed, pack, unpack
from services.job.reference import allowed_keys, describe_allowed, list_keys, write_doc

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
        ("name: a\nscenes: -3", ["scenes", "-3", "at least 1"]),
        ("name: a\nphysics: {step_hz: abc}", ["physics.step_hz", "'abc'", "whole number"]),
        ("name: a\nstart: {clearance_m: [0.3, 0.1]}", ["start.clearance_m", "0.3", "empty"]),
        ("name: a\ncategories: [mug, sofa]", ["categories.sofa", "no source offers it", "bottle, camera"]),
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
        ("name: a\nurdf: 3", ["urdf: there is no such key"]),
        (
            "name: a\nassets: {objects: [{source: urdf, folder: ., urdf: 3}]}",
            ["assets.objects.0.urdf: there is no such key"],
        ),
        ("name: a\nassets: {objects: [{source: urdf, folder: 3}]}", ["assets.objects.0.folder: 3"]),
        ("name: a\ncameras: {depth: {offset_m: [0, 0, x]}}", ["cameras.depth.offset_m.2: 'x'"]),
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


HOSTILE_KEYS = [
    ("name: a\ncategories: [[mug]]", ["categories: [['mug']]", "list of names"]),
    ("name: a\ncategories: [{a: b}]", ["categories", "list of names"]),
    ('name: a\nassets: {objects: [{source: urdf, folder: "a\\0b"}]}', ["assets.objects.0.folder", "'a\\x00b'"]),
    (
        "name: a\nassets: {objects: [{source: urdf, folder: ~nobody7/b}]}",
        ["assets.objects.0.folder", "~nobody7/b", "user"],
    ),
    (
        "name: a\nassets: {tables: [{source: shapenet, folder: ~nobody7}]}",
        ["assets.tables.0.folder", "~nobody7", "user"],
    ),
    (f"name: a\nassets: {{objects: [{{source: urdf, folder: {'x' * 9000}}}]}}", ["assets.objects.0.folder", "4000"]),
    ('name: a\nassets: {objects: [{source: urdf, folder: ., licence: "\\e[31m"}]}', ["objects.0.licence", "control"]),
    ('name: a\nassets: {objects: [{source: "\\e[31m"}]}', ["assets.objects.0", "\\x1b[31m"]),
    ('name: "\\e[31mred"', ["name", "'\\x1b[31mred'"]),
    ('name: a\n"\\e[31mred": 3', ["\\x1b[31mred", "no such key"]),
    (f"name: a\n{'k' * 900}: 3", ["kkk...", "no such key"]),
    (f"name: {'a' * 9000}", ["name", "aaa...", "1000 characters"]),
    (f"name: a\nassets: {{objects: [{'{source: procedural},' * 101}]}}", ["assets.objects", "at most 100"]),
    ("name: a\nscenes: 1" + "0" * 30, ["first_scene + scenes", "10000000000"]),
    ("name: a\nfirst_scene: 9999999999\nscenes: 2", ["first_scene + scenes is 10000000001"]),
    ("name: a\nseed: 1" + "0" * 30, ["seed", "at most"]),
    ("name: a\nphysics: {friction: 1.0e+400}", ["physics.friction", "finite"]),
    ("name: a\nverso: 1" + "0" * 50, ["verso", "newer"]),
    (f"name: a\n#{'x' * 400_000}", ["250000 bytes"]),
    ("name: a\nassets: {objects: [{source: procedural, weight: 1.0e+308}]}", ["assets.objects.0.weight", "1e+308"]),
]


@pytest.mark.parametrize(("text", "words"), HOSTILE_KEYS)
def test_a_hostile_value_is_told_in_a_line_that_a_terminal_can_show(tmp_path, text, words):
    message = fault(tmp_path, text)
    assert "job.yaml" in message
    assert all(word in message for word in words), message
    assert message.isprintable() and len(message) < 700 + len(str(tmp_path)), message


def test_thousands_of_faults_are_told_by_the_first_twenty(tmp_path):
    message = fault(tmp_path, "name: a\n" + "".join(f"k{i}: 1\n" for i in range(9000)))
    assert len(message.splitlines()) == 21
    assert message.splitlines()[-1].endswith("and 8980 faults more")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ("name: a".encode("utf-16"), "UTF-8"),
        (b"name: \xe9", "UTF-8"),
        (b"name: a\0b", "not YAML"),
    ],
)
def test_a_file_that_is_no_text_is_told(tmp_path, data, words):
    (tmp_path / "job.yaml").write_bytes(data)
    with pytest.raises(JobError, match=words):
        load_job(tmp_path / "job.yaml")


def test_a_byte_order_mark_is_no_part_of_the_first_key(tmp_path):
    (tmp_path / "job.yaml").write_bytes("\ufeffname: a\r\nscenes: 3\r\n".encode())
    assert load_job(tmp_path / "job.yaml").scenes == 3


@pytest.mark.parametrize("path", ["/dev/zero", "/proc/self/mem", "."])
def test_what_is_no_job_file_is_told_and_not_read_for_ever(path):
    with pytest.raises(JobError) as caught:
        load_job(Path(path))
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("seed=" + "9" * 100_000, ["seed=999", "100000 characters"]),
        ("categories=" + "[" * 2_000, ["categories=[[[", "levels deep"]),
        (".".join("a" * 2_000) + "=1", ["a.a.a", "no such key"]),
        ("start." + "x" * 10_000 + ".y=1", ["start.xxx", "no such key"]),
        ("name=a\udcff", ["name=a\\udcff"]),
        ("\x1b[31m=3", ["\\x1b[31m"]),
        ("start={a: *b}", ["'*b'"]),
        ('assets.objects=[{source: urdf, folder: "a\\0b"}]', ["assets.objects.0.folder", "control"]),
        ("assets.objects=[{source: urdf, folder: ~nobody7}]", ["assets.objects.0.folder", "user"]),
        ("run.workers=1" + "0" * 40, ["run.workers"]),
        ("assets.objects." + "9" * 300 + "=1", ["assets.objects"]),
        ("licence=" + "x" * 300_000, ["250000 characters"]),
    ],
)
def test_a_hostile_change_is_told_in_a_line(tmp_path, change, words):
    message = fault(tmp_path, "name: a\nassets: {objects: [{source: procedural}]}", change)
    assert all(word in message for word in words), message
    assert message.isprintable() and len(message) < 700 + len(str(tmp_path)), message


def told(**keys) -> list[str]:
    with pytest.raises(ValidationError) as refusal:
        Job.model_validate({"name": "t", **keys})
    return [describe_fault(fault) for fault in refusal.value.errors()]


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"name": "a b"}, "name: 'a b': a name is 1 to 64 letters, digits, ., - and _"),
        ({"physics": 3}, "physics: 3: must hold keys with values"),
        ({"assets": {"objects": 3}}, "assets.objects: 3: must be a list"),
        ({"assets": {"objects": [3]}}, "assets.objects.0: 3: must hold keys with values"),
        ({"assets": {"objects": [{}]}}, "assets.objects.0: {}: must have a key 'source'"),
        ({"assets": {"objects": [{"source": "urd"}]}}, "its 'source' did you mean 'urdf'? must be 'procedural', "),
        ({"start": {"offset_m": 3}}, "start.offset_m: 3: must be two numbers: [low, high]"),
        ({"start": {"offset_m": [3]}}, "start.offset_m.1: is missing"),
        ({"start": {"offset_m": [1, 2, 3]}}, "start.offset_m: [1, 2, 3]: must have at most 2 of them"),
        (
            {"start": {"pose": "uprigth"}},
            "start.pose: 'uprigth': did you mean 'upright'? must be 'upright', 'tumbled' or",
        ),
        ({"scenes": "x"}, "scenes: 'x': must be a whole number"),
        ({"scenes": 2.5}, "scenes: 2.5: must be a whole number"),
        ({"scenes": 0}, "scenes: 0: must be at least 1"),
        ({"categories": []}, "categories: {}: must have at least 1 of them"),
        ({"check": {"raycast_share": 2}}, "check.raycast_share: 2: must be at most 1"),
        ({"check": {"raycast_share": "half"}}, "check.raycast_share: 'half': must be a number"),
        ({"physics": {"exact_rest": "maybe"}}, "physics.exact_rest: 'maybe': must be true or false"),
        ({"phisics": 1}, "phisics: there is no such key; did you mean 'physics'?"),
    ],
)
def test_a_fault_is_one_line_of_plain_words(keys, words):
    lines = told(**keys)
    assert any(line.startswith(words) or words in line for line in lines), lines
    for line in lines:
        assert "\n" not in line
        for jargon in ("pattern", "dictionary", "instance of", "tuple", "discriminator", "Input", "parse"):
            assert jargon not in line


HOSTILE = "verso: 1\nname: odd\nscenes: 4  # $(touch x); `touch y` | 'quote' \"quote\" && > < * ? ~ \\\n"


@given(st.binary(max_size=2000))
def test_what_is_packed_comes_back_from_a_word_that_no_shell_changes(data):
    word = pack(data)
    assert re.fullmatch(r"job:[A-Za-z0-9_-]*", word) and is_packed(word)
    assert unpack(word, 2000) == data


def test_a_packed_job_is_the_same_job(tmp_path):
    file = tmp_path / "odd.yaml"
    file.write_text(HOSTILE)
    word = pack_job(file)
    assert load_job(Path(word), ["scenes=9"]) == load_job(file, ["scenes=9"])


@pytest.mark.parametrize(
    "change", [lambda w: w[:-6], lambda w: w[:9] + "A" + w[10:], lambda w: w + "$", lambda w: MARK]
)
def test_a_word_that_was_cut_or_changed_is_told(change):
    with pytest.raises(JobError, match="pack it again"):
        unpack(change(pack(HOSTILE.encode())), 2000)


def test_a_small_word_cannot_become_a_large_file():
    bomb = pack(bytes(50_000_000))
    assert len(bomb) < 70_000
    assert len(unpack(bomb, 250_000)) == 250_001


def test_a_file_that_is_too_long_for_a_command_line_is_refused_with_the_way_out():
    random = np.random.default_rng(1).bytes(MOST_CHARACTERS)
    with pytest.raises(JobError, match="file_mounts"):
        pack(random)


def test_folders_of_a_packed_job_have_whole_paths(tmp_path):
    file = tmp_path / "meshes.yaml"
    file.write_text("name: meshes\nscenes: 2\ncategories: [mug]\nassets: {objects: [{source: urdf, folder: meshes}]}\n")
    with pytest.raises(JobError, match=r"assets\.objects\.0\.folder: 'meshes': a packed job has no folder of its own"):
        pack_job(file)
    file.write_text(file.read_text().replace("folder: meshes", "folder: /srv/meshes"))
    assert is_packed(pack_job(file))


def test_every_key_is_documented_and_the_page_is_current():
    assert [path for path, field in list_keys() if not field.description] == []
    assert (ROOT / "docs" / "job.md").read_text() == write_doc()


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("images.projection.splat", "whole number, >= 1, <= 15"),
        ("start.offset_m", "[low, high]"),
        ("cameras.depth.offset_m", "list of 3 numbers"),
        ("run.workers", "whole number, >= 1, <= 100000 or nothing"),
        ("assets.objects[urdf].up", "`x`, `y`, `z` or map"),
    ],
)
def test_types_and_bounds_are_told_in_words(key, words):
    assert describe_allowed(dict(list_keys())[key]) == words


def test_allowed_keys_are_the_siblings_also_below_a_position_in_a_list():
    assert allowed_keys(["assets", "split", "trian"]) == ["test", "train", "val"]
    assert {"diagonal_m", "folder", "instances"} <= set(allowed_keys(["assets", "objects", "0", "wieght"]))
