"""A shard of small scenes through the real path onto disk: ranges, commits under way, errors, the fingerprint, and cameras
that nobody would choose: each scene is made whole, against the ray caster, or is a row that says why not.
"""

import itertools
import os
import platform
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from importlib.metadata import distribution
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from schemas.dataset.commit import Span
from schemas.dataset.layout import FINGERPRINT_FILE, IMAGES, commit_path
from schemas.dataset.shard import Blame, Fingerprint, ShardOrder, ShardReport
from schemas.errors import FingerprintError, MachineError
from schemas.job.job import Job
from schemas.scene.shape import REGION_FIRST_OBJECT
from schemas.scene.view import MODALITIES
from services.job.job_file import validate_job
from services.run.worker_entry import processor_flags
from tests.effects.scenes import SMALL
from workers.assets.catalogue import open_catalogue
from workers.physics.bullet import World
from workers.render.raster.gbuffer import shared_renderer
from workers.shard import fingerprint
from workers.shard import run_shard as module
from workers.shard.fingerprint import (
    TIER_LIBRARIES,
    binaries_digest,
    canary_digest,
    maths_digest,
    numpy_simd,
    take_fingerprint,
)
from workers.shard.run_shard import describe, explain, keep_traceback, run_shard
from workers.source import SOURCE_PACKAGES, code_digest
from workers.store.attempt import Attempt, blamed_scene, staged_attempts
from workers.store.commit import committed_files, read_record
from workers.store.images import decode_png
from workers.store.ledger import range_rows
from workers.store.local import LocalStage, LocalStore


def run_job(
    job: Job, out: Path, *spans: tuple[int, int], is_over: Callable[[], bool] = lambda: False, **changes: Any
) -> ShardReport:
    """The report of a shard of these ranges, with changes of its order."""
    whole = tuple(Span(start=start, stop=stop) for start, stop in spans)
    order = ShardOrder.of(str(out), job, "test").model_copy(update={"spans": whole, **changes})
    LocalStore(out).prepare()
    return run_shard(order, open_catalogue(job.assets, Path(), tuple(job.categories)), is_over)


ROOT = Path(__file__).resolve().parents[3]
OTHER = Fingerprint(canary="0" * 64, code="0" * 64, libraries={}, simd="none", renderer="none")


def run(out: Path, *starts: int, mode: str = "record", **changes) -> ShardReport:
    """A shard of ranges of two scenes."""
    job = validate_job({**SMALL, "run": {"fingerprint": mode}}, "a test")
    return run_job(job, out, *((start, start + 2) for start in starts or (0,)), **changes)


def failures_of(out: Path) -> list[dict]:
    record = read_record(LocalStore(out), 0)
    assert record is not None
    return range_rows(LocalStore(out), [record], "failures").to_pylist()


def raises(error: Exception) -> Callable[..., None]:
    def fail(*_: object) -> None:
        raise error

    return fail


# ---------------------------------------------------------------------------------------------- ranges


def test_every_range_is_committed_and_reported_in_order_and_a_worker_that_is_to_end_begins_no_other(tmp_path):
    asked = itertools.count()
    report = run(tmp_path, 0, 2, 4, is_over=lambda: next(asked) == 2)
    assert [(span.start, span.stop, span.won, span.made) for span in report.spans] == [(0, 2, True, 2), (2, 4, True, 2)]
    assert {"assets", "plan", "physics", "render", "encode", "write", "commit"} <= report.seconds.keys()
    assert [path.name for path in (tmp_path / "_staging").glob("*/*")] == []
    (again,) = run(tmp_path, 0).spans
    assert (again.won, again.conflict) == (False, None), "a second attempt loses, and made the same bytes"
    assert run(tmp_path, 6, is_over=lambda: True).spans == ()


def test_the_next_range_is_made_while_one_at_a_time_is_committed_and_has_no_scene_in_progress(tmp_path, monkeypatch):
    begun, ended, noted, events = threading.Event(), threading.Event(), [], []
    begin_scene, end_scenes, flush, commit = Attempt.begin_scene, Attempt.end_scenes, LocalStage.flush, Attempt.commit

    def note_begin(attempt, scene_id):
        begin_scene(attempt, scene_id)
        if scene_id == 2:
            begun.set()

    def note_end(attempt):
        end_scenes(attempt)
        if attempt.span.start == 2:
            ended.set()

    def wait(stage):
        assert begun.wait(60.0), "scene 2 is not begun while the range before it is committed"
        assert ended.wait(60.0)
        store = LocalStore(tmp_path)
        noted.extend(blamed_scene(store, start, name) for start, name in staged_attempts(store))
        flush(stage)

    def watched(attempt, job_change):
        events.append(attempt.span.start)
        result = commit(attempt, job_change)
        events.append(attempt.span.start)
        return result

    for owner, name, new in (
        (Attempt, "begin_scene", note_begin),
        (Attempt, "end_scenes", note_end),
        (Attempt, "commit", watched),
        (LocalStage, "flush", wait),
    ):
        monkeypatch.setattr(owner, name, new)
    assert [span.won for span in run(tmp_path, 0, 2).spans] == [True, True]
    assert noted[:2] == [None, None] and events == [0, 0, 2, 2]


def test_a_range_that_cannot_be_committed_is_told_and_made_again_by_the_next_run(tmp_path, monkeypatch):
    begin_scene, begun = Attempt.begin_scene, []
    with monkeypatch.context() as patch:
        patch.setattr(Attempt, "begin_scene", lambda attempt, n: (begun.append(n), begin_scene(attempt, n)))
        patch.setattr(LocalStage, "flush", raises(MachineError("the disk is full")))
        with pytest.raises(MachineError, match="the disk is full"):
            run(tmp_path, 0, 2, 4)
    assert begun == [0, 1, 2, 3], "no further range is begun"
    store = LocalStore(tmp_path)
    assert [store.size(commit_path(start)) for start in (0, 2, 4)] == [None] * 3
    assert [span.won for span in run(tmp_path, 0, 2).spans] == [True] * 2


def test_an_error_in_a_range_lets_the_commit_before_it_end(tmp_path, monkeypatch):
    flush, failed = LocalStage.flush, threading.Event()

    def fail(attempt, scene_id):
        if scene_id == 2:
            failed.set()
            raise MachineError("the GPU is gone")

    def wait(stage):
        failed.wait(60.0)
        flush(stage)

    monkeypatch.setattr(Attempt, "begin_scene", fail)
    monkeypatch.setattr(LocalStage, "flush", wait)
    with pytest.raises(MachineError, match="the GPU is gone"):
        run(tmp_path, 0, 2)
    store = LocalStore(tmp_path)
    assert store.size(commit_path(0)) is not None and store.size(commit_path(2)) is None


# ---------------------------------------------------------------------------------------------- errors nobody expected


def break_scene(monkeypatch: pytest.MonkeyPatch, scene_id: int, error: Exception) -> None:
    real = module.make_scene

    def make(context, scene, stopwatch):
        if scene == scene_id:
            raise error
        return real(context, scene, stopwatch)

    monkeypatch.setattr(module, "make_scene", make)


def test_a_bug_in_one_scene_is_a_row_names_what_was_in_it_and_the_others_are_made(tmp_path, monkeypatch):
    break_scene(monkeypatch, 1, ZeroDivisionError("no such thing\nand more"))
    (span,) = run(tmp_path).spans
    assert (span.made, span.failed) == (1, {"environmental: bug": 1})
    (row,) = failures_of(tmp_path)
    assert (row["scene_id"], row["stage"], row["kind"], row["reason"]) == (1, "worker", "environmental", "bug")
    assert row["detail"].startswith("ZeroDivisionError: no such thing at test_run_shard.py:")
    (message,) = span.bugs
    assert message.startswith(f"scene 1 ({row['category']} ") and ", on table " in message and "\n" not in message
    kept = (tmp_path / "_logs" / "scene-1.txt").read_text()
    assert "ZeroDivisionError: no such thing" in kept and "Traceback" in kept
    assert describe(KeyError()) == "KeyError" and explain(RuntimeError("x" * 5000)).detail.count("x") < 250
    (tmp_path / "file").write_text("somebody's")
    assert keep_traceback(LocalStore(tmp_path / "file"), 3, ValueError("x")) == "", "a log must not end the range"


def test_an_output_that_breaks_the_schema_is_a_row_too(tmp_path, monkeypatch):
    real = module.run_scene

    def lacking(context, scene_id, total):
        output = real(context, scene_id, total)
        if scene_id == 0:
            output.rows["views"][0]["width"] = "wide"
        return output

    monkeypatch.setattr(module, "run_scene", lacking)
    (span,) = run(tmp_path).spans
    assert (span.made, span.failed) == (1, {"environmental: bug": 1})
    assert "scene 0 (" in span.bugs[0] and failures_of(tmp_path)[0]["scene_id"] == 0
    images = [path.name for path in tmp_path.glob("*/*.png")]
    assert images and not any("00000." in name or "00001." in name for name in images)


def test_memory_that_runs_out_is_told_as_that_and_an_error_of_the_machine_ends_the_shard(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        break_scene(patch, 0, np._core._exceptions._ArrayMemoryError((10**6, 10**6), np.dtype(float)))
        (span,) = run(tmp_path / "a").spans
    assert span.failed == {"environmental: memory": 1}
    assert "use fewer workers" in failures_of(tmp_path / "a")[0]["detail"]
    break_scene(monkeypatch, 1, MachineError("the disk is full"))
    with pytest.raises(MachineError, match="the disk is full"):
        run(tmp_path / "b")
    assert read_record(LocalStore(tmp_path / "b"), 0) is None


def test_a_scene_that_killed_its_workers_is_a_row_and_is_not_tried_again(tmp_path):
    blame = Blame(scene_id=1, reason="killed", detail="three workers died in it", attempts=3)
    (span,) = run(tmp_path, blamed=(blame,)).spans
    assert (span.made, span.failed) == (1, {"environmental: killed": 1})
    (row,) = failures_of(tmp_path)
    assert (row["scene_id"], row["stage"], row["detail"], row["attempts"]) == (1, "worker", blame.detail, 3)


# ---------------------------------------------------------------------------------------------- the stack


def test_a_worker_of_another_stack_is_refused_unless_the_job_records_stacks(tmp_path):
    (tmp_path / FINGERPRINT_FILE).parent.mkdir(parents=True)
    (tmp_path / FINGERPRINT_FILE).write_text(OTHER.model_dump_json())
    with pytest.raises(FingerprintError, match=f"the dataset's is {OTHER.digest[:12]}"):
        run(tmp_path, mode="strict")
    assert run(tmp_path, mode="record").spans[0].won


def test_the_same_stack_has_the_same_fingerprint_and_names_what_the_bytes_depend_on():
    first, second = (take_fingerprint(shared_renderer(), "raster") for _ in range(2))
    assert first == second and first.digest == second.digest
    assert first.libraries["numpy"] == np.__version__ and first.python.endswith(platform.python_version())
    assert first.code == code_digest() and len(first.canary) == 64
    assert first.simd == numpy_simd() and first.renderer == shared_renderer().name
    assert TIER_LIBRARIES["pathtraced"][0] not in first.libraries


def test_another_build_of_a_library_is_another_stack_under_the_same_versions(tmp_path, monkeypatch):
    (tmp_path / "bullet.so").write_bytes(b"as it was built" * 1000)
    digests = [binaries_digest(("pybullet", "numpy"), str(tmp_path / "bullet.so"))]
    assert digests == [binaries_digest(("pybullet", "numpy"), str(tmp_path / "bullet.so"))]
    (tmp_path / "bullet.so").write_bytes(b"as it was Built" * 1000)
    digests.append(binaries_digest(("pybullet", "numpy"), str(tmp_path / "bullet.so")))
    record = distribution("numpy").read_text("RECORD")
    changed = SimpleNamespace(read_text=lambda _: re.sub(r"(\.so,sha256=)....", r"\1AAAA", record))
    monkeypatch.setattr(fingerprint, "distribution", lambda name: changed if name == "numpy" else distribution(name))
    digests.append(binaries_digest(("pybullet", "numpy"), str(tmp_path / "bullet.so")))
    assert len(set(digests)) == 3
    before = canary_digest(shared_renderer())  # and what PyBullet computes reaches the canary, in its last bits too
    advance = World.advance

    def nudged(world: World) -> None:
        advance(world)
        if len(world.bodies) == 3:
            (x, y, z), spin = world.velocity(1)
            world.set_velocity((x, y, float(np.nextafter(z, 0.0))), spin, 1)

    monkeypatch.setattr(World, "advance", nudged)
    assert canary_digest(shared_renderer()) != before


def asked(code: str, cwd: Path = ROOT, **environ: str) -> list[str]:
    """The words that a process prints, which sees nothing but the packages in `cwd`."""
    whole = f"import sys; sys.path.insert(0, '.'); {code}"
    command = [sys.executable, "-P", "-c", whole]
    done = subprocess.run(command, cwd=cwd, env={**os.environ, **environ}, capture_output=True, text=True, check=True)
    return done.stdout.split()


@pytest.mark.minute
def test_a_c_library_that_multiplies_and_adds_in_two_steps_is_another_stack_and_one_without_avx512_is_not():
    ask = "from workers.shard.fingerprint import maths_digest; print(maths_digest())"
    less = "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX512DQ,-AVX512CD"
    assert asked(ask, GLIBC_TUNABLES=less) == [maths_digest()]
    if "fma" not in processor_flags():
        pytest.skip("this processor has no fused multiplication")
    assert asked(ask, GLIBC_TUNABLES="glibc.cpu.hwcaps=-FMA,-AVX2") != [maths_digest()]


def test_a_copy_of_the_code_has_the_same_digest_and_a_changed_line_another(tmp_path):
    for package in SOURCE_PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    ask = "from workers.source import code_digest; print(code_digest(), 'numpy' in sys.modules)"
    assert asked(ask, tmp_path) == [code_digest(), "False"]
    with (tmp_path / "workers" / "scene" / "plan.py").open("a") as file:
        file.write("# changed\n")
    assert asked(ask, tmp_path)[0] != code_digest()


# ---------------------------------------------------------------------------------------------- extreme cameras

ARTICLE = [image for image in IMAGES if MODALITIES[image.pixels].target is None]
"""The images that a job without targets has."""
IN_THE_MIDDLE = {"offset_m": [0.0, 0.0], "pose": "placed"}
EVERY_EFFECT = {"depth_noise": {}, "distortion": {"k1": -0.1}, "rgb_noise": {}, "exposure": {}}
HARD_TO_DERIVE = {"projection": {"splat": 15, "hidden_point_removal": True}}


def job_of(width: int, height: int, focal: float, **changes):
    """A job whose sensor looks along the middle of its image."""
    sensor = {"width": width, "height": height, "fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2}
    cameras = {"sensor": sensor, **changes.pop("cameras", {})}
    tree = {"name": "extreme", "seed": 5, "cameras": cameras, "check": {"raycast_share": 1.0}, **changes}
    return validate_job(tree, "test")


def made_in(job, out: Path, scenes: int = 2):
    """(scenes made, failures by reason, the store) of a shard of one range."""
    (span,) = run_job(job, out, (0, scenes)).spans
    assert span.made + sum(span.failed.values()) == scenes
    return span.made, span.failed, LocalStore(out)


def images_of(store: LocalStore) -> dict[str, np.ndarray]:
    """Every image of the range, read back."""
    record = read_record(store, 0)
    assert record is not None
    paths = [entry.path for entry in committed_files(store, record) if entry.path.endswith(".png")]
    return {path: decode_png(store.read(path), path) for path in paths}


@pytest.mark.minute
def test_images_of_one_pixel_or_without_an_inside_are_made_whole(tmp_path):
    hard = {"sensor": EVERY_EFFECT, "images": HARD_TO_DERIVE}
    sizes = ((2, 2), (3, 1), (1, 3), (2, 640), (4096, 1))
    cases = [(1, 1, 525.0, {"render": {"samples": 4}, **changes}) for changes in ({}, hard)]
    cases += [(width, height, 60.0, hard) for width, height in sizes]
    for number, (width, height, focal, changes) in enumerate(cases):
        job = job_of(width, height, focal, start=IN_THE_MIDDLE, **changes)
        made, failed, store = made_in(job, tmp_path / str(number), scenes=4)
        assert made > 0 and set(failed) <= {"intrinsic: object_not_seen"}, (width, height)
        images = images_of(store)
        assert {image.shape[:2] for image in images.values()} == {(height, width)}
        assert len(images) == made * len(ARTICLE), "and no patch, which would be larger than the image"


@pytest.mark.minute
def test_a_sensor_that_sees_half_the_world_in_a_pixel_says_that_it_sees_no_object(tmp_path):
    for n, focal in enumerate((0.001, 0.5)):
        made, failed, _ = made_in(job_of(64, 48, focal), tmp_path / str(n))
        assert (made, failed) == (0, {"intrinsic: object_not_seen": 2})


@pytest.mark.minute
def test_a_sensor_that_sees_micrometres_makes_scenes_or_says_what_disagrees(tmp_path):
    made, failed, store = made_in(job_of(64, 48, 1e6, start=IN_THE_MIDDLE), tmp_path, scenes=4)
    assert set(failed) <= {f"intrinsic: {reason}" for reason in ("views_disagree", "object_not_seen")}
    assert made > 0
    paths = [path for path in images_of(store) if Path(path).name.startswith("segment") and "patch" not in path]
    assert paths and all(decode_png(store.read(path), path).min() >= REGION_FIRST_OBJECT for path in paths[:1])


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("changes", [{}, {"sensor": EVERY_EFFECT, "render": {"samples": 4}}])
def test_the_largest_image_is_made_whole(tmp_path, changes):
    job = job_of(4096, 4096, 3360.0, check={"raycast_share": 0.0}, run={"scene_timeout_s": 1000.0}, **changes)
    made, failed, store = made_in(job, tmp_path, scenes=1)
    assert (made, failed) == (1, {})
    whole = [image for path, image in images_of(store).items() if "/patches/" not in path]
    assert len(whole) == len(ARTICLE) and {image.shape[:2] for image in whole} == {(4096, 4096)}


def test_a_gpu_that_is_asked_for_and_not_there_stops_the_shard_before_any_scene(tmp_path, monkeypatch):
    monkeypatch.setattr(shared_renderer(), "name", "llvmpipe (LLVM 15.0.6, 256 bits)")
    with pytest.raises(MachineError, match=r"run\.device is gpu"):
        made_in(job_of(64, 48, 60.0, run={"device": "gpu"}), tmp_path)
    assert not (tmp_path / FINGERPRINT_FILE).exists() and not (tmp_path / commit_path(0)).exists()
