"""Ours, the floor and the straightforward script do the same work; a small camera, because no time is asserted."""

import json
import os

import cv2
import pytest

from schemas.errors import MachineError
from services.bench.floor import choose_encoders, committed_files, images_of, kind_of, run_floor, write_durably
from services.bench.handover import hand_over
from services.bench.machine import pinned
from services.bench.memory import describe
from services.bench.script_process import script_process
from services.bench.stages import open_workbench
from services.cli import main
from services.jobfile import validate_job

SMALL = {
    "name": "small",
    "seed": 5,
    "cameras": {"sensor": {"width": 160, "height": 120, "fx": 131.25, "fy": 131.25, "cx": 80.0, "cy": 60.0}},
    "images": {"patch": {"width": 32, "height": 24}},
    "check": {"raycast_share": 0.0, "mirror_agreement_mm": 5.0},
    "run": {"range_size": 2},
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A workbench with one committed range, and that range."""
    bench = open_workbench(validate_job(SMALL, "test"), tmp_path_factory.getbasetemp(), tmp_path_factory.mktemp("ours"))
    span = bench.next_span(2)
    bench.run(span)
    return bench, span


def pictures(folder) -> dict[str, tuple[tuple[int, ...], str]]:
    """Shape and type of every PNG below a folder."""
    found = {}
    for path in folder.rglob("*.png"):
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert pixels is not None
        found[str(path.relative_to(folder))] = (pixels.shape, str(pixels.dtype))
    return found


def test_script_and_ours_write_the_same_images(bench, tmp_path):
    bench, span = bench
    given = [hand_over(scene, bench.context.job, tmp_path / str(n)) for n, scene in enumerate(bench.scenes(span))]
    with script_process() as (script, _):
        lap = script.run(given, tmp_path / "script")
    assert lap.scenes == len(given) == 2
    assert pictures(tmp_path / "script") == pictures(bench.store.root)
    inputs = list((tmp_path / "script").glob("*/segment*.png"))
    assert any({1, 2, 3} <= set(cv2.imread(str(path), cv2.IMREAD_UNCHANGED).ravel()) for path in inputs)


def test_a_script_that_dies_says_why(tmp_path):
    with script_process() as (script, _), pytest.raises(MachineError, match="No such file"):
        script.ask({"scene": str(tmp_path / "nothing.json"), "out": str(tmp_path)})


def test_the_floor_writes_the_bytes_that_ours_committed(bench, tmp_path):
    bench, span = bench
    record = bench.record(span)
    files = committed_files(bench.store.root, record)
    chosen = choose_encoders(images_of(files))
    assert set(chosen) == {"rgb", "uint16", "uint8"}
    lap = run_floor(bench.context.renderer, bench.scenes(span), files, chosen, tmp_path / "floor")
    assert list(lap.stages_s) == ["draw", "encode", "write"]
    written = {str(p.relative_to(tmp_path / "floor")): p.read_bytes() for p in (tmp_path / "floor").rglob("*.*")}
    assert written == files
    assert sum(map(len, written.values())) == sum(entry.bytes for entry in record.files)
    assert write_durably(files, tmp_path / "again") == sum(map(len, files.values()))


def test_every_encoder_that_may_be_chosen_is_lossless(bench):
    bench, span = bench
    images = images_of(committed_files(bench.store.root, bench.record(span)))
    chosen = choose_encoders(images)
    encoded = {str(n): chosen[kind_of(pixels)][1](pixels) for n, (pixels, _) in enumerate(images)}
    again = images_of({f"{name}.png": data for name, data in encoded.items()})
    assert all((a == b).all() for (a, _), (b, _) in zip(images, again, strict=True))


def test_cores_are_given_back_also_after_an_error():
    before = os.sched_getaffinity(0)

    def fail() -> None:
        with pinned() as core:
            assert os.sched_getaffinity(0) == {core}
            raise KeyError(core)

    with pytest.raises(KeyError):
        fail()
    assert os.sched_getaffinity(0) == before


def test_memory_is_compared_after_it_settled():
    samples = [(100.0 + n, 0.1) for n in range(10)] + [(110.0, 0.1)] * 90
    told = describe(samples, 1600)
    assert (told.settled_after, told.settled_mb, told.peak_mb) == (160, 109.0, 110.0)
    assert told.grown == 110.0 / 109.0 - 1.0 and told.slowed == 0.0


def test_bench_prints_one_object_last_and_leaves_nothing(tmp_path, capsys):
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps(SMALL))
    before = os.sched_getaffinity(0)
    folder = tmp_path / "data"
    assert main(["bench", str(job), "--scenes", "3", "--folder", str(folder), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert figures["rounds"] == 2 and figures["scenes"] == 3
    assert figures["ratio"]["least"] <= figures["ratio"]["median"] <= figures["ratio"]["most"]
    assert {"render", "encode", "write", "commit", "physics"} <= set(figures["ours"]["stages_ms"])
    assert {"physics", "scene", "render", "projection", "write"} <= set(figures["script"]["stages_ms"])
    assert os.sched_getaffinity(0) == before
    assert list(folder.iterdir()) == []
