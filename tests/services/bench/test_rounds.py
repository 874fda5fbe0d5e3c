"""The sides of a round: ours, the straightforward script and the lower bound make the same files of the same scenes; a small
camera, because no time is asserted."""

import json
import os
import pickle
import shutil
from statistics import median

import cv2
import numpy as np
import pytest
import trimesh

from schemas.dataset.commit import Span
from schemas.environment import FOR_SPEED
from schemas.errors import MachineError, OutputError, RunError, SceneError
from services.bench import script as module
from services.bench.measure import Part, bench_folder, make_in_memory, open_workbench, run_lower_bound, run_part
from services.bench.script import hand_over, start_script
from services.cli.main import main
from services.job.job_file import validate_job
from tests.datasets import SMALL as ANY_SMALL
from workers.pool import Pool
from workers.store.commit import committed_files, read_record

SMALL = {**ANY_SMALL, "run": {"range_size": 2}}
JOB = validate_job(SMALL, "test")


@pytest.fixture(scope="module")
def ours(tmp_path_factory):
    """A workbench with one committed range, that range, and its scenes as they are made in memory."""
    bench = open_workbench(JOB, tmp_path_factory.getbasetemp(), tmp_path_factory.mktemp("ours"))
    span = bench.next_span(4)
    bench.run(span)
    return bench, span, make_in_memory(bench.context, span)


@pytest.fixture(scope="module")
def given(ours, tmp_path_factory):
    """The range's scenes as the script gets them."""
    folder = tmp_path_factory.mktemp("given")
    return [hand_over(scene, JOB, folder) for scene in ours[2]]


# ---------------------------------------------------------------------------------------------- ours


def test_the_scenes_in_memory_are_those_of_the_committed_files(ours):
    bench, span, made = ours
    assert [scene.plan.scene_id for scene in made] == list(span.scene_ids) and bench.next_scene == span.stop
    assert all((bench.store.root / path).read_bytes() == data for path, data in bench.files(span).items())


def test_where_no_scene_can_be_made_the_reason_is_told(ours, tmp_path, monkeypatch):
    def fail(*_: object) -> None:
        raise SceneError("physics", "fell off")

    monkeypatch.setattr("workers.shard.run_shard.make_scene", fail)
    bench = open_workbench(JOB, tmp_path, tmp_path / "out")
    with pytest.raises(RunError, match=r"none of the scenes 0 to 1 could be made: .*physics"):
        bench.run(bench.next_span(2))


@pytest.mark.minute
def test_a_plain_process_makes_every_range_of_its_span_on_its_core(tmp_path):
    before = os.sched_getaffinity(0)
    parts = [Part(JOB, tmp_path, tmp_path / str(n), Span(start=0, stop=3), min(before)) for n in range(2)]
    with Pool(run_part, processes=2) as pool:
        laps = [pickle.loads(answer) for _, answer in pool.run(parts)]
    assert [lap.scenes for lap in laps] == [3, 3] and all(0 < lap.cpu_s <= lap.wall_s for lap in laps)
    for part in parts:
        commits = (part.out / "manifest" / "_commits").glob("*.json")
        assert sorted(int(path.stem) for path in commits) == [0, 2]
    assert os.sched_getaffinity(0) == before


def test_a_folder_that_cannot_be_made_is_told_of(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="choose another --folder"), bench_folder(tmp_path / "file"):
        pass


# ---------------------------------------------------------------------------------------------- the script


def test_the_script_is_given_our_poses_shapes_and_images(ours, given):
    bench, _, made = ours
    for path, scene in zip(given, made, strict=True):
        told, start = json.loads(path.read_text()), scene.plan.objects[0]
        assert np.array(told["T_world_obj"]) == pytest.approx(start.T_world_obj)
        assert f'mass value="{start.asset.mass.mass_kg}"' in (path.parent / "object.urdf").read_text()
        mesh = trimesh.load(path.parent / "object.obj", process=False)
        assert mesh.vertices == pytest.approx(start.asset.shape.mesh.vertices, abs=1e-8)
        assert (mesh.faces == start.asset.shape.mesh.faces).all()
        images = [image["path"] for pair in told["pairs"] for image in pair["images"]]
        assert images and all((bench.store.root / image).is_file() for image in images)


def pictures(folder) -> dict[str, np.ndarray]:
    """Every PNG below a folder, by its path."""
    paths = sorted(folder.rglob("*.png"))
    return {str(path.relative_to(folder)): np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) for path in paths}


def inputs(folder, content: str) -> list[np.ndarray]:
    """Input views of one kind, in the order of their scenes."""
    paths = sorted(folder.glob(f"*/{content}[0-9]*[02468].png"), key=lambda path: path.name)
    return [np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) for path in paths]


@pytest.mark.minute
def test_script_and_ours_make_the_same_images_with_the_same_floor_and_shadows(ours, given, tmp_path):
    """On the floor alone, where the plain look has one colour; a floor may have hardly a pattern, and its shadow be hidden. On
    a floor that we paint in one colour, what is a fifth darker than most of it lies in a shadow."""
    root = ours[0].store.root
    for path in given:
        shutil.copytree(path.parent, tmp_path / "painted" / path.parent.name)
        floor = trimesh.load(path.parent / "floor.glb", force="mesh")
        floor.visual = trimesh.visual.ColorVisuals(floor, face_colors=(128, 128, 128, 255))
        floor.export(tmp_path / "painted" / path.parent.name / "floor.glb")
    with start_script() as script:
        for look in ("plain", "same"):
            assert script.run(given, tmp_path / look, look).scenes == len(given) == 4
        script.run([tmp_path / "painted" / path.parent.name / path.name for path in given], tmp_path / "shaded", "same")
    formats = {name: (image.shape, image.dtype) for name, image in pictures(root).items()}
    for look in ("plain", "same"):
        assert {name: (image.shape, image.dtype) for name, image in pictures(tmp_path / look).items()} == formats
        assert any({1, 2, 3} <= set(image.ravel()) for image in inputs(tmp_path / look, "segment"))
    folders = {"ours": root, **{name: tmp_path / name for name in ("plain", "same", "shaded")}}
    alike, dark = [], []
    for n, region in enumerate(inputs(root, "segment")):
        shade = {name: inputs(folder, "RGB")[n].mean(axis=2)[region == 1] for name, folder in folders.items()}
        assert shade["same"].mean() > 20, "not black"
        like = {name: np.corrcoef(shade["ours"], shade[name])[0, 1] for name in ("plain", "same")}
        alike.append(shade["same"].std() > 1.5 * shade["plain"].std() and like["same"] > max(0.5, like["plain"] + 0.2))
        dark.append(float((shade["shaded"] < 0.8 * median(shade["shaded"])).mean()))
    assert len(alike) == 4 and sum(alike) >= 2 and sum(0.005 < share < 0.5 for share in dark) >= 2, dark


def test_a_script_that_dies_says_why_and_none_inherits_what_is_set_for_our_speed(tmp_path, monkeypatch):
    with start_script() as script, pytest.raises(MachineError, match=r"the script ended.*No such file"):
        script.ask({"scene": str(tmp_path / "nothing.json"), "out": str(tmp_path), "look": "plain"})
    [(name, value)] = FOR_SPEED.items()
    monkeypatch.setenv("OTHER", "kept")
    for set_to, seen in ((value, None), ("glibc.cpu.hwcaps=-AVX2", "glibc.cpu.hwcaps=-AVX2")):
        monkeypatch.setenv(name, set_to)
        inherited = module._plain_environment()
        assert (inherited.get(name), inherited["OTHER"]) == (seen, "kept")


# ---------------------------------------------------------------------------------------------- the lower bound


def test_the_lower_bound_writes_the_bytes_that_ours_committed(ours, tmp_path):
    bench, span, made = ours
    files = bench.files(span)
    lap = run_lower_bound(bench.context.renderer, made, files, tmp_path / "floor")
    assert list(lap.stages_s) == ["draw", "encode", "write"] and all(0 < s <= lap.wall_s for s in lap.stages_s.values())
    assert lap.apart_s > 0, "shapes reach the GPU before the clock"
    written = {str(p.relative_to(tmp_path / "floor")): p.read_bytes() for p in (tmp_path / "floor").rglob("*.*")}
    assert written == files
    record = read_record(bench.store, span.start)
    assert sum(map(len, written.values())) == sum(entry.bytes for entry in committed_files(bench.store, record))


# ---------------------------------------------------------------------------------------------- the command


@pytest.mark.minute
def test_bench_prints_one_object_last_and_leaves_nothing(tmp_path, capsys):
    job, folder = tmp_path / "job.yaml", tmp_path / "data"
    job.write_text(json.dumps(SMALL))
    before = os.sched_getaffinity(0)
    assert main(["bench", str(job), "--scenes", "3", "--folder", str(folder), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert figures["rounds"] == 2 and figures["scenes"] == 3 and figures["job"] == "small"
    for look in ("plain", "same"):
        ratio = figures["script"][look]["ratio"]
        assert ratio["least"] <= ratio["median"] <= ratio["most"]
        assert {"physics", "scene", "render", "projection", "write"} <= set(figures["script"][look]["stages_ms"])
    assert {"render", "encode", "write", "commit", "physics"} <= set(figures["ours"]["stages_ms"])
    assert os.sched_getaffinity(0) == before and list(folder.iterdir()) == []
