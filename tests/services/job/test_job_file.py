"""From a job file to a `Job`: every fault by file, key, value and what is allowed, in a short line, at a bounded cost."""

import copy
import random
import re
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import set_key
from schemas.errors import JobError
from schemas.job.assets import ProceduralSource
from schemas.job.job import Job
from services.cli.main import main
from services.cli.reference import describe_allowed, job_page, list_keys
from services.job.job_file import NEEDS, allowed_keys, describe_idle, load_job, pack_job, validate_job
from services.job.packed import MARK, MOST_CHARACTERS, is_packed, pack, unpack
from tests.mutations import mutated_bytes, mutated_tree

ROOT = Path(__file__).resolve().parents[3]
EXAMPLES = sorted((ROOT / "deploy" / "jobs").glob("*.yaml"))


def write(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "job.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def fault(path: Path, *changes: str) -> str:
    with pytest.raises(JobError) as caught:
        load_job(path, changes)
    assert caught.value.exit_code == 2
    return str(caught.value)


def check_lines(message: str, path: Path) -> None:
    """At most 21 lines, each of which names the file, and is short and printable."""
    lines = message.splitlines()
    assert 1 <= len(lines) <= 21
    for line in lines:
        assert str(path) in line and line.isprintable() and len(line) < 800 + len(str(path)), line
        for jargon in ("pattern", "dictionary", "instance of", "tuple", "discriminator", "Input", "Traceback"):
            assert jargon not in line.replace("'dictionary'", "") or "k" * 9 in line or ".sphere" in line, line  # keys


# ------------------------------------------------------------------------------------------------ faults

FAULTS: tuple[tuple[str | bytes, list[str]], ...] = (
    ("scens: 3", ["scens: there is no such key; did you mean 'scenes'"]),
    ("scenes: -3", ["scenes: -3: must be at least 1"]),
    ("scenes: 2.5", ["scenes: 2.5: must be a whole number"]),
    ("scenes: 1" + "0" * 30, ["first_scene + scenes", "10000000000"]),
    ("physics: 3", ["physics: 3: must hold keys with values"]),
    ("physics: {step_hz: abc}", ["physics.step_hz: 'abc': must be a whole number"]),
    ("physics: {max_settle_s: .inf}", ["physics.max_settle_s", "finite"]),
    (
        "physics: {max_settle_s: 0.2}",
        ["physics", "rest.window_s is 0.25 s and max_settle_s 0.2 s: nothing"],
    ),
    ("physics: {exact_rest: maybe}", ["physics.exact_rest: 'maybe': must be true or false"]),
    ("check: {raycast_share: 2}", ["check.raycast_share: 2: must be at most 1"]),
    ("check: {raycast_share: half}", ["check.raycast_share: 'half': must be a number"]),
    ("start: {clearance_m: [0.3, 0.1]}", ["start.clearance_m", "0.3", "empty"]),
    ("start: {offset_m: 3}", ["start.offset_m: 3: must be two numbers: [low, high]"]),
    ("start: {offset_m: [3]}", ["start.offset_m.1: is missing"]),
    ("start: {offset_m: [1, 2, 3]}", ["start.offset_m: [1, 2, 3]: must have at most 2 of them"]),
    (
        "start: {pose: uprigth}",
        ["start.pose: 'uprigth': did you mean 'upright'? must be 'upright', 'tumbled', 'placed' or"],
    ),
    ("assets: {density_kg_m3: {mug: -1}}", ["assets.density_kg_m3.mug: -1: must be greater than 0"]),
    ("assets: {density_kg_m3: {table: 1}}", ["assets.density_kg_m3.table: 'table': the name of what objects stand on"]),
    ("physics: {friction: {mug: 6}}", ["physics.friction.mug: 6: must be at most 5"]),
    ("physics: {friction: {mgu: 1}}", ["physics.friction.mgu: no source offers it; did you mean 'mug'?", "box, table"]),
    ("cameras: {depth: {offset_m: [0, 0, x]}}", ["cameras.depth.offset_m.2: 'x'"]),
    *(
        (
            f"cameras: {{orbit: {{radius_m: {text}}}}}",
            [f"cameras.orbit.radius_m: '{text}': write metres, fit, or a share"],
        )
        for text in ("fitt", "60%", "0%", "6 cm")
    ),
    *(
        (f"cameras: {{more: [{{name: {name}, ring: {{}}}}]}}", [f"cameras.more.0.name: '{shown or name}'", told])
        for name, shown, told in (
            ("input", "", "is the name of a view that every pair may have: choose another"),
            ("Projected", "", "is the name of a view that every pair may have: choose another"),
            ("'a b'", "a b", "1 to 32 ASCII letters, digits and -"),
            *(
                (name, "", "1 to 32 ASCII letters, digits and -")
                for name in ("a/b", "a_b", "ünt", "..", "9a", "a" * 33)
            ),
        )
    ),
    *(
        (f"cameras: {{more: [{{name: a, {keys}}}]}}", told)
        for keys, told in (
            (
                "about: table",
                ["cameras.more.0: ", "camera a has none of beside, ring, sphere, poses, preset: give one"],
            ),
            ("ring: {}, preset: lrm", ["camera a has ring and preset of beside, ring"]),
            ("ring: {count: 1001}", ["cameras.more.0.ring.count: 1001: must be at most 1000"]),
            ("ring: {radius_m: near}", ["cameras.more.0.ring.radius_m: 'near': write metres, fit, or a share"]),
            ("ring: {start_rad: .inf}", ["cameras.more.0.ring.start_rad.0: inf: must be a finite number"]),
            ("ring: {}, about: floor", ["cameras.more.0.about: 'floor': must be 'object', 'table' or 'world'"]),
            ("ring: {}, about: [0, 0]", ["cameras.more.0.about.2: is missing"]),
            ("ring: {}, about: table", ["radius_m fit frames the objects, so about must be object"]),
            ("ring: {}, offset_m: [1, 0, 0]", ["offset_m and rotation_deg are for beside, and it has ring"]),
            ("beside: input, roll_deg: 5", ["beside says where it looks, and roll_deg cannot act: leave roll_deg out"]),
            ("poses: p.csv, about: table", ["poses says where it looks, and about cannot act: leave about out"]),
            (
                "sphere: {pattern: uniform, height_m: [3, 4], radius_m: 2}",
                ["height_m [3.0, 4.0] is nowhere on a sphere"],
            ),
            ("sphere: {height_m: 1}", ["height_m is for the patterns uniform and cube", "leave it out"]),
        )
    ),
    (
        "cameras: {more: [{name: A, ring: {}}, {name: a, ring: {}}]}",
        ["names a twice: each camera needs a name of its own"],
    ),
    ("scene: studio\ncameras: {more: [{name: a, beside: mirror}]}", ["set mirror.enabled: true, or beside: input"]),
    *(
        (f"scene: studio\n{keys}", [f"scene is studio, and {told}"])
        for keys, told in (
            (
                "objects_per_scene: 2\nstart: {arrange: pile}",
                "objects_per_scene is not 1: a studio scene shows one object",
            ),
            ("start: {arrange: pile}", "start.arrange is pile: leave it out"),
            ("start: {pose: placed}", "start.pose is placed: use as_given, upright or tumbled"),
            ("render: {tier: pathtraced}", "render.tier is pathtraced: use raster or flat"),
            ("cameras: {more: [{name: a, ring: {radius_m: 1}, about: table}]}", "camera a looks at the table"),
        )
    ),
    ("scene: studio\nsensor: {rgb_noise: {}}", ["set studio.background to a colour, such as [1, 1, 1]"]),
    ("scene: studio\nstudio: {background: white}", ["studio.background: 'white': must be 'transparent'"]),
    ("scene: studio\nstudio: {background: [2, 0, 0]}", ["studio.background.0: 2: must be at most 1"]),
    ("studio: {scale: unit_cube}", ["studio has keys, and scene is tabletop: set scene: studio, or leave them out"]),
    ("start: {pose: as_given}", ["start.pose is as_given", "use upright, tumbled or placed"]),
    ("cameras: {mirror: {T_z_m: 6%}}", ["cameras.mirror.T_z_m: '6%': must be 'fit'"]),
    ("cameras: {orbit: {radius_m: -1}}", ["cameras.orbit.radius_m: -1: must be greater than 0"]),
    ("categories: [mug, sofa]", ["categories.sofa", "no source offers it", "bottle, camera"]),
    ("categories: [mug, mug]", ["categories", "twice"]),
    ("categories: []", ["categories: {}: must have at least 1 of them"]),
    ("categories: [[mug]]", ["categories: [['mug']]", "list of names"]),
    ("assets: {objects: 3}", ["assets.objects: 3: must be a list"]),
    ("assets: {objects: [3]}", ["assets.objects.0: 3: must hold keys with values"]),
    ("assets: {objects: [{}]}", ["assets.objects.0: {}: must have a key 'source'"]),
    ("assets: {objects: [{source: librar}]}", ["assets.objects.0", "did you mean 'library'? must be 'procedural', "]),
    ('assets: {objects: [{source: "\\e[31m"}]}', ["assets.objects.0", "\\x1b[31m"]),
    ("assets: {objects: [{source: library}]}", ["assets.objects.0.folder: is missing"]),
    ("assets: {objects: [{source: library, folder: 3}]}", ["assets.objects.0.folder: 3: must be text"]),
    (
        f"assets: {{objects: [{{source: procedural, instances: {10**13}}}]}}",
        ["instances: 10000000000000: must be at most"],
    ),
    ("assets: {objects: [{source: library, folder: ., up: 3}]}", ["assets.objects.0.up: there is no such key"]),
    ('assets: {objects: [{source: library, folder: "a\\0b"}]}', ["assets.objects.0.folder", "'a\\x00b'", "control"]),
    ("assets: {objects: [{source: library, folder: ~nobody7/b}]}", ["objects.0.folder", "~nobody7/b", "no such user"]),
    (f"assets: {{objects: [{{source: library, folder: {'x' * 9000}}}]}}", ["assets.objects.0.folder", "4000"]),
    ("assets: {objects: [{source: procedural, weight: 1.0e+308}]}", ["assets.objects.0.weight", "1e+308"]),
    (f"assets: {{objects: [{'{source: procedural},' * 101}]}}", ["assets.objects", "at most 100"]),
    ("assets: {split: {train: 0.5}}", ["assets.split", "0.7"]),
    ("images: {depth_units_per_m: 10000}", ["images", "80000", "65535"]),
    ("images: {projection: {splat: 4}}", ["images.projection.splat", "4", "even"]),
    ("objects_per_scene: 51", ["objects_per_scene", "51", "from 1 to 50"]),
    ("objects_per_scene: [2, 1]", ["objects_per_scene", "[2, 1]", "empty"]),
    ("objects_per_scene: [1, 2.5]", ["objects_per_scene", "2.5", "[low, high]"]),
    ("verso: 2", ["verso", "2", "newer"]),
    ('"\\e[31mred": 3', ["\\x1b[31mred", "no such key"]),
    (f"{'k' * 900}: 3", ["kkk...", "no such key"]),
    ("3: b", ["line 2", "3", "not a word"]),
    ("seed: 1\nseed: 2", ["line 3", "'seed'", "twice"]),
    (f"#{'x' * 400_000}", ["250000 bytes"]),
    ("cameras: {mirror: {enabled: false}}", ["set images.projection.enabled: false too"]),
    (
        "cameras: {mirror: {enabled: false}, depth: {enabled: false}}\nimages: {projection: {enabled: false}}\n"
        "targets: {views: [covisible]}",
        ["asks for covisible", "name some in cameras.more, or leave it out"],
    ),
    (
        "captures: {}\ncameras: {depth: {enabled: false}}\ntargets: {views: [covisible]}",
        ["asks for covisible: a capture"],
    ),
    ("render: {rgb: false}\nsensor: {rgb_noise: {}}", ["sensor.rgb_noise"]),
    *(  # what float32 on the GPU would make infinite
        (f"cameras: {{{branch}: {{{name}: {value}}}}}", [f"cameras.{branch}.{name}"])
        for branch, name, value in (
            *(("sensor", "fx", "1.0e+300"), ("sensor", "fy", "1.0e-300"), ("sensor", "cx", "1.0e+300")),
            *(("orbit", "radius_m", "1.0e+300"), ("mirror", "T_z_m", "1.0e+300")),
            ("depth", "offset_m", "[0, 1.0e+300, 0]"),
        )
    ),
)
"""What stands below `name: a`, and words of the answer."""

WHOLE_FILES: tuple[tuple[str | bytes, list[str]], ...] = (
    ("scenes: 3", ["name: is missing, and has no default"]),
    ("name: a b", ["name: 'a b': a name is 1 to 64 letters, digits, ., - and _"]),
    ('name: "\\e[31mred"', ["name", "'\\x1b[31mred'"]),
    (f"name: {'a' * 9000}", ["name", "aaa...", "1000 characters"]),
    ("- a\n- b", ["list", "keys and values"]),
    ("", ["nothing"]),
    ("name: a".encode("utf-16"), ["UTF-8"]),
    (b"name: \xe9", ["UTF-8"]),
    (b"name: a\0b", ["not YAML"]),
)


def test_a_fault_is_told_by_file_key_value_and_remedy(tmp_path):
    whole = [(f"name: a\n{text}" if isinstance(text, str) else text, words) for text, words in FAULTS]
    for text, words in (*whole, *WHOLE_FILES):
        path = write(tmp_path, text)
        message = fault(path)
        check_lines(message, path)
        assert all(word in message for word in words), message


def test_many_faults_are_told_at_once_and_thousands_by_the_first_twenty(tmp_path):
    assert len(fault(write(tmp_path, "name: a\nscenes: 0\nseed: -1\nfoo: 1")).splitlines()) == 3
    lines = fault(write(tmp_path, "name: a\n" + "".join(f"k{i}: 1\n" for i in range(9000)))).splitlines()
    assert len(lines) == 21 and lines[-1].endswith("and 8980 faults more")


def test_what_is_no_job_file_is_told_and_not_read_for_ever(tmp_path):
    assert "deploy/jobs" in fault(tmp_path / "none.yaml")
    for path in ("/dev/zero", "/proc/self/mem", "."):
        assert len(fault(Path(path))) < 200


CHANGES = (
    ("nonsense", ["write it as path.to.key=value"]),
    ("=3", ["write it as path.to.key=value"]),
    ("name.deeper=3", ["'name' is 'a' and has no key 'deeper'"]),
    ("name.deeper.more=3", ["'name' is 'a' and has no key 'deeper'"]),
    ("assets.objects.7.weight=1", ["'7' must be a position from 0 to 0"]),
    ("assets.objects.first.weight=1", ["'first' must be a position from 0 to 0"]),
    ("assets.objects." + "9" * 300 + "=1", ["assets.objects"]),
    ("scenes=[", ["scenes=["]),
    ("seed=" + "9" * 100_000, ["seed=999", "100000 characters"]),
    ("categories=" + "[" * 2_000, ["categories=[[[", "levels deep"]),
    (".".join("a" * 2_000) + "=1", ["a.a.a", "no such key"]),
    ("start." + "x" * 10_000 + ".y=1", ["start.xxx", "no such key"]),
    ("name=a\udcff", ["name=a\\udcff"]),
    ("\x1b[31m=3", ["\\x1b[31m"]),
    ("start={a: *b}", ["'*b'"]),
    ("run.workers=1" + "0" * 40, ["run.workers"]),
    ("licence=" + "x" * 300_000, ["250000 characters"]),
)


def test_changes_reach_every_depth_and_one_that_cannot_be_made_is_told_in_a_line(tmp_path):
    assert "'cameras' is None and has no key 'more'" in fault(write(tmp_path, "name: a\ncameras:"), "cameras.more=3")
    path = write(tmp_path, "name: a\nassets: {objects: [{source: procedural}]}")
    for change, words in CHANGES:
        message = fault(path, change)
        assert all(word in message for word in words), message
        assert message.isprintable() and len(message) < 700 + len(str(tmp_path)), message
    job = load_job(path, ["physics.rest.window_s=0.5", "assets.objects.0.weight=3", "categories=[mug]", "scenes=9"])
    assert (job.physics.rest.window_s, job.assets.objects[0].weight) == (0.5, 3.0)
    assert (dict(job.categories), job.scenes) == ({"mug": 1.0}, 9)


# ------------------------------------------------------------------------------------------------ jobs


def test_the_examples_are_jobs_and_a_job_with_all_defaults_is_the_articles(tmp_path):
    assert [load_job(path).name for path in EXAMPLES] == [path.stem for path in EXAMPLES] != []
    assert load_job(write(tmp_path, "\ufeffname: a\r\nscenes: 3\r\n")).scenes == 3  # a byte order mark
    job = Job(name="a")
    sensor, orbit = job.cameras.sensor, job.cameras.orbit
    assert (sensor.width, sensor.height, sensor.fx, sensor.fy, sensor.cx, sensor.cy) == (640, 480, 525, 525, 320, 240)
    assert (*orbit.inclination_rad, orbit.radius_m, job.cameras.mirror.T_z_m) == (0.7, 0.9, 2.5, 1.3)
    assert job.cameras.depth.offset_m == (-0.051, 0.001, -0.001)
    assert (job.images.patch.width, job.images.patch.height, job.images.depth_units_per_m) == (128, 96, 5000)
    assert job.start.offset_m == (-0.25, 0.25) and len(job.categories) == 8


def test_a_count_of_objects_is_a_number_or_a_range_and_is_written_as_it_was():
    for asked, ends, written in ((3, (3, 3), 3), ([1, 5], (1, 5), [1, 5]), ([4, 4], (4, 4), 4)):
        job = validate_job({"name": "a", "objects_per_scene": asked}, "test")
        dumped = job.model_dump(mode="json")
        assert (job.objects_per_scene, dumped["objects_per_scene"]) == (ends, written)
        assert Job.model_validate(dumped) == job


def test_every_key_is_documented_and_the_page_is_current():
    keys = {path: field for path, field, _ in list_keys()}
    assert [path for path, field in keys.items() if not field.description] == []
    assert (ROOT / "docs" / "job.md").read_text() == job_page()
    for key, words in (
        ("images.projection.splat", "integer >=1,<=15"),
        ("start.offset_m", "[low, high]"),
        ("cameras.depth.offset_m", "3 numbers"),
        ("run.workers", "integer >=1,<=100000 or `null`"),
        ("assets.objects[library].diagonal_m", "number >0 or `null`"),
    ):
        assert describe_allowed(keys[key]) == words
    assert allowed_keys(["assets", "split", "trian"]) == ["named", "test", "train", "val"]
    assert {"diagonal_m", "folder", "instances"} <= set(allowed_keys(["assets", "objects", "0", "wieght"]))


# ------------------------------------------------------------------------------------------------ packed

ODD = "verso: 1\nname: odd\nscenes: 4  # $(touch x); `touch y` | 'quote' \"quote\" && > < * ? ~ \\\n"


@given(st.binary(max_size=2000))
def test_what_is_packed_comes_back_from_a_word_that_no_shell_changes(data):
    word = pack(data)
    assert re.fullmatch(r"job:[A-Za-z0-9_-]*", word) and is_packed(word)
    assert unpack(word, 2000) == data


def test_a_packed_job_is_the_same_job_with_whole_paths(tmp_path):
    file = write(tmp_path, ODD)
    assert load_job(Path(pack_job(file)), ["scenes=9"]) == load_job(file, ["scenes=9"])
    meshes = "name: meshes\nscenes: 2\ncategories: [mug]\nassets: {objects: [{source: library, folder: %s}]}\n"
    why = r"assets\.objects\.0\.folder: 'meshes': a packed job has no folder of its own"
    with pytest.raises(JobError, match=why):
        pack_job(write(tmp_path, meshes % "meshes"))
    with pytest.raises(JobError, match=why):
        load_job(Path(pack((meshes % "meshes").encode())))
    assert is_packed(pack_job(write(tmp_path, meshes % "/srv/meshes")))


def test_a_word_that_was_cut_or_changed_or_is_too_long_is_told():
    word = pack(ODD.encode())
    for damaged in (word[:-6], word[:9] + "A" + word[10:], word + "$", MARK):
        with pytest.raises(JobError, match="pack it again"):
            unpack(damaged, 2000)
    bomb = pack(bytes(50_000_000))
    assert len(bomb) < 70_000 and len(unpack(bomb, 250_000)) == 250_001
    with pytest.raises(JobError, match="file_mounts"):
        pack(np.random.default_rng(1).bytes(MOST_CHARACTERS))


# ------------------------------------------------------------------------------------------------ mutated

MOST_SECONDS = 5.0
"""Of processor time for one file: 0.05 s is usual; cores are shared and caches cold."""

MOST_MB = 200.0
"""By which a few hundred files may raise the peak of this process's memory."""


def mutated_job(number: int) -> bytes:
    """A job file: an example, or one with every key, mutated as text or as a tree."""
    dice = random.Random(number)
    data = dice.choice(EXAMPLES).read_bytes()
    tree = yaml.safe_load(data)
    if dice.random() < 0.5:
        tree = Job.model_validate(tree).model_dump(mode="json")
    if dice.random() < 0.4:
        return mutated_bytes(dice, dice.choice((data, yaml.safe_dump(tree).encode())))
    flow = dice.choice((None, True, False))
    text = yaml.dump(mutated_tree(dice, tree), Dumper=yaml.CSafeDumper, default_flow_style=flow, sort_keys=False)
    return mutated_bytes(dice, text.encode()) if dice.random() < 0.2 else text.encode()


def peak_mb() -> float:
    return int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0]) / 1024


@pytest.mark.parametrize("numbers", [range(40), pytest.param(range(100, 2100), marks=pytest.mark.slow)], ids=len)
def test_mutated_jobs_are_jobs_or_are_refused_at_a_small_cost(numbers, tmp_path, capsys, monkeypatch):
    for name in (
        "services.run.run_job.measure_scene",
        "workers.shard.framing.require_framed",
    ):  # this is about reading jobs
        monkeypatch.setattr(name, lambda job, catalogue: None)
    path, out, outcomes = tmp_path / "job.yaml", str(tmp_path / "out"), Counter()
    main(["run", str(EXAMPLES[-1]), "--dry-run", "--out", out])  # loads what reading a job loads
    before = peak_mb()
    for number in numbers:
        path.write_bytes(mutated_job(number))
        started, built_in = time.process_time(), True
        try:
            job = load_job(path)
            assert Job.model_validate(job.model_dump(mode="json")) == job
            # Others name folders of meshes, whose reading has tests of its own.
            built_in = all(isinstance(source, ProceduralSource) for source in (*job.assets.objects, *job.assets.tables))
            outcomes["job"] += 1
        except JobError as error:
            check_lines(str(error), path)
            outcomes["refused"] += 1
        if built_in:
            assert main(["run", str(path), "--dry-run", "--out", out]) in (0, 2), number
            printed = capsys.readouterr()
            assert "Traceback" not in printed.out + printed.err and "\x1b" not in printed.out + printed.err
        assert time.process_time() - started < MOST_SECONDS, number
    assert sorted(tmp_path.iterdir()) == [path]
    assert peak_mb() - before < MOST_MB
    assert outcomes["job"] > 2 and outcomes["refused"] > len(numbers) // 3  # the mutations reach both


# ------------------------------------------------------------------------------------------------ keys that cannot act

OFF = {
    "render.tier": ("flat", {"render": {"rgb": False}}, "render.rgb is false"),
    "render.samples": (4, {"render": {"tier": "flat"}}, "render.tier is not raster"),
    "render.path_samples": (64, {}, "render.tier is not pathtraced"),
    "render.path_bounces": (2, {}, "render.tier is not pathtraced"),
    "cameras.mirror.T_z_m": (0.8, {"cameras": {"mirror": {"enabled": False}}}, "cameras.mirror.enabled is false"),
    "cameras.mirror.percentile": (9.0, {"cameras": {"mirror": {"enabled": False}}}, "cameras.mirror.enabled is false"),
    "cameras.depth.offset_m": ([0.0, 0.0, 0.0], {"cameras": {"depth": {"enabled": False}}}, "cameras.depth.enabled"),
    "images.projection.splat": (3, {"images": {"projection": {"enabled": False}}}, "projection.enabled is false"),
    "images.projection.hidden_point_removal": (
        True,
        {"images": {"projection": {"enabled": False}}},
        "projection.enabled",
    ),
    "start.arrange": ("pile", {}, "objects_per_scene is 1"),
    "start.pile_offset_m": ([-0.1, 0.1], {"objects_per_scene": 3}, "start.arrange is spread"),
    "physics.concavity": (0.1, {"physics": {"collision": "hull"}}, "makes no convex parts"),
    "studio.size_m": (2.0, {"scene": "studio"}, "studio.scale is metric"),
    "look.recolour": ("packaging", {"render": {"tier": "flat"}}, "render.tier is flat"),
    "look.floor": (
        {"colours": [[0.5, 0.5, 0.5]]},
        {"render": {"tier": "flat"}},
        "given and has no effect: render.tier is flat",
    ),
    "look.table": ({"folder": "x"}, {"render": {"rgb": False}}, "render.rgb is false"),
    "look.background": ("x", {"render": {"tier": "flat"}}, "render.tier is flat"),
    "look.lights": ({}, {"render": {"tier": "flat"}}, "render.tier is flat"),
    "look.environment": ({}, {"render": {"rgb": False}}, "render.rgb is false"),
}
ON = {
    "render": {"tier": "pathtraced", "path_samples": 4, "path_bounces": 2},
    "cameras": {"mirror": {"T_z_m": 0.8, "percentile": 9.0}, "depth": {"offset_m": [0.0, 0.0, 0.0]}},
    "images": {"projection": {"splat": 3, "hidden_point_removal": True}},
    "objects_per_scene": 3,
    "start": {"arrange": "pile", "pile_offset_m": [-0.1, 0.1]},
    "physics": {"concavity": 0.1},
}


def job_of(key="", value=None, changes=None):
    """A job with changes, and a key set to a value."""
    tree = copy.deepcopy({"verso": 1, "name": "t", **(changes or {})})
    if key:
        set_key(tree, key, value)
    if tree.get("cameras", {}).get("mirror", {}).get("enabled") is False:
        tree.setdefault("images", {}).setdefault("projection", {"enabled": False})
    return validate_job(tree, "t")


def test_each_key_that_cannot_act_is_told_with_its_reason():
    assert OFF.keys() == NEEDS.keys()
    for key, (value, changes, why) in OFF.items():
        (line,) = describe_idle(job_of(key, value, changes))
        assert line.startswith(f"{key} is ") and why in line, (key, line)


def test_keys_of_scenes_that_a_capture_has_not_are_told_and_its_lens_and_board_are_tried_before_it_is_made(
    tmp_path, capsys
):
    own = {"captures": {"simulate": {"views": 4}}, "cameras": {"depth": {"enabled": False}}}
    assert describe_idle(job_of(changes=own)) == []
    for key, value in (("start.pose", "tumbled"), ("physics.step_hz", 480), ("cameras.orbit.radius_m", "fit")):
        (line,) = describe_idle(job_of(key, value, own))
        assert line.startswith(f"{key} is {value} and has no effect: ")
    job = tmp_path / "job.yaml"
    for branch, value, why in (
        ("simulate", {"views": 4, "distortion": {"k1": -0.3}}, "the lens k1=-0.3 .* folds over"),
        (
            "board",
            {"columns": 10, "rows": 7, "marker_m": 0.03, "gap_m": 0.01},
            "has 50 markers, and the board needs 70",
        ),
    ):
        job.write_text(yaml.safe_dump({"verso": 1, "name": "t", "captures": {branch: value}}))
        assert main(["run", str(job), "--dry-run", "--out", str(tmp_path / "out")]) == 2
        assert re.search(why, capsys.readouterr().err)


def test_nothing_is_told_of_keys_that_act_or_are_at_their_defaults():
    assert describe_idle(job_of()) == describe_idle(job_of(changes=ON)) == []
    assert describe_idle(job_of("render.samples", 4)) == []
    assert describe_idle(job_of(changes={"render": {"rgb": False}})) == []
    assert describe_idle(job_of(changes={"scene": "studio"})) == []
