"""Ours, the floor and the straightforward script do the same work; a small camera, because no time is asserted."""

import json
import os
import shutil

import cv2
import numpy as np
import pytest

from schemas.errors import MachineError
from services.bench import others
from services.bench.encoders import choose_encoders, encoders, kind_of
from services.bench.handover import hand_over
from services.bench.lower_bound import committed_files, images_of, run_lower_bound, write_durably
from services.bench.machine import pinned
from services.bench.side_process import side_process
from services.bench.stages import open_workbench
from services.cli.main import main
from services.job.read import validate_job

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
    span = bench.next_span(4)
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


SCRIPT = "services.bench.baseline"


@pytest.fixture(scope="module")
def given(bench, tmp_path_factory):
    """The range's scenes as the others get them."""
    bench, span = bench
    folder = tmp_path_factory.mktemp("given")
    return [hand_over(scene, bench.context.job, folder / str(n)) for n, scene in enumerate(bench.scenes(span))]


@pytest.fixture(scope="module")
def looks(given, tmp_path_factory):
    """Folders with what the script makes of them, by look."""
    folder = tmp_path_factory.mktemp("looks")
    with side_process(SCRIPT) as (script, _):
        for look in ("plain", "same"):
            assert script.run(given, folder / look, {"look": look}).scenes == len(given) == 4
    return {look: folder / look for look in ("plain", "same")}


def inputs(folder, content: str) -> list[np.ndarray]:
    """Input views of one kind."""
    paths = sorted(folder.glob(f"*/{content}[0-9]*[02468].png"))
    return [np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) for path in paths]


@pytest.mark.parametrize("look", ["plain", "same"])
def test_script_and_ours_write_the_same_images(bench, looks, look):
    assert pictures(looks[look]) == pictures(bench[0].store.root)
    assert any({1, 2, 3} <= set(image.ravel()) for image in inputs(looks[look], "segment"))


def test_the_same_look_has_the_texture_and_the_shadows_that_ours_has(bench, looks):
    """On the floor alone, where the plain look has one colour; a floor may have hardly a pattern, and its shadow be hidden."""
    regions, alike = inputs(bench[0].store.root, "segment"), []
    assert len(regions) == 4
    for n, region in enumerate(regions):
        floor = region == 1
        images = {"ours": bench[0].store.root, "plain": looks["plain"], "same": looks["same"]}
        shade = {name: inputs(root, "RGB")[n].mean(axis=2)[floor] for name, root in images.items()}
        assert shade["same"].mean() > 20, "not black"
        like = {name: np.corrcoef(shade["ours"], shade[name])[0, 1] for name in ("plain", "same")}
        alike.append(shade["same"].std() > 1.5 * shade["plain"].std() and like["same"] > max(0.5, like["plain"] + 0.2))
    assert sum(alike) >= 2


def test_the_same_look_throws_shadows(bench, given, tmp_path):
    """On a floor of one colour, what is a fifth darker than most of it lies in a shadow."""
    regions = inputs(bench[0].store.root, "segment")
    for path in given:
        shutil.copytree(path.parent, tmp_path / path.parent.name)
        picture = tmp_path / path.parent.name / "floor.png"
        cv2.imwrite(str(picture), np.full((8, 8, 3), 128, np.uint8))
    plain_floors = [tmp_path / path.parent.name / path.name for path in given]
    with side_process(SCRIPT) as (script, _):
        script.run(plain_floors, tmp_path / "out", {"look": "same"})
    dark = []
    for region, image in zip(regions, inputs(tmp_path / "out", "RGB"), strict=True):
        shade = image.mean(axis=2)[region == 1]
        dark.append(float((shade < 0.8 * np.median(shade)).mean()))
    assert sum(0.005 < share < 0.5 for share in dark) >= 2, dark


def test_only_the_raster_tier_has_a_same_look_to_be_compared_with(bench):
    job = bench[0].context.job
    flat = job.model_copy(update={"render": job.render.model_copy(update={"tier": "flat"})})
    assert {"script_plain", "script_same_look"} <= {side.name for side in others.sides_of(job)}
    assert "script_plain" in {side.name for side in others.sides_of(flat)}
    assert "script_same_look" not in {side.name for side in others.sides_of(flat)}


def test_mujoco_sees_the_regions_and_depths_that_we_see(bench, given, tmp_path):
    """An independent renderer: all but a few pixels along edges agree, in every view."""
    pytest.importorskip("mujoco")
    bench, span = bench
    with side_process("services.bench.mujoco_side") as (mujoco, _):
        for n, (path, scene) in enumerate(zip(given, bench.scenes(span), strict=True)):
            answer = mujoco.ask({"scene": str(path), "out": str(tmp_path), "keep": str(tmp_path / f"{n}.npz")})
            assert set(answer["stages_s"]) == {"scene", "physics", "render"}
            kept = np.load(tmp_path / f"{n}.npz")
            for view in scene.pairs[0].views[:3]:
                same = kept[f"{view.role}0_region"] == view.region
                assert same.mean() > 0.999
                table = same & (view.region == 2) & (view.depth > 0)
                error_m = np.abs(kept[f"{view.role}0_depth"] - view.depth / 5000.0)[table]
                assert np.median(error_m) < 0.0002


def test_a_script_that_dies_says_why(tmp_path):
    with side_process(SCRIPT) as (script, _), pytest.raises(MachineError, match=r"baseline ended.*No such file"):
        script.ask({"scene": str(tmp_path / "nothing.json"), "out": str(tmp_path), "look": "plain"})


def test_the_floor_writes_the_bytes_that_ours_committed(bench, tmp_path):
    bench, span = bench
    record = bench.record(span)
    files = committed_files(bench.store.root, record)
    chosen = choose_encoders(images_of(files))
    assert set(chosen) == {"rgb", "uint16", "uint8"}
    lap = run_lower_bound(bench.context.renderer, bench.scenes(span), files, chosen, tmp_path / "floor")
    assert list(lap.stages_s) == ["draw", "encode", "write"]
    assert lap.apart_s > 0, "shapes reach the GPU before the clock"
    written = {str(p.relative_to(tmp_path / "floor")): p.read_bytes() for p in (tmp_path / "floor").rglob("*.*")}
    assert written == files
    assert sum(map(len, written.values())) == sum(entry.bytes for entry in record.files)
    assert write_durably(files, tmp_path / "again") == sum(map(len, files.values()))


@pytest.mark.parametrize("name", encoders())
def test_every_encoder_that_may_be_chosen_is_lossless(bench, name):
    bench, span = bench
    images = images_of(committed_files(bench.store.root, bench.record(span)))
    noise = np.random.default_rng(1).integers(0, 65536, (5, 7), np.uint16)
    images += [(noise, 0), (noise.astype(np.uint8)[:1, :1], 0)]
    encoded = {f"{n}.png": encoders()[name](pixels) for n, (pixels, _) in enumerate(images)}
    for (pixels, _), (again, _) in zip(images, images_of(encoded), strict=True):
        assert pixels.dtype == again.dtype
        np.testing.assert_array_equal(pixels, again)


def test_an_encoder_that_hardly_compresses_is_no_floor(bench):
    bench, span = bench
    rgb = [one for one in images_of(committed_files(bench.store.root, bench.record(span))) if kind_of(one[0]) == "rgb"]
    _, encode = choose_encoders(rgb)["rgb"]
    assert sum(len(encode(pixels)) for pixels, _ in rgb) <= 2 * sum(size for _, size in rgb)
    with pytest.raises(ValueError, match="empty"):  # not one of them is that small
        choose_encoders([(pixels, size // 100) for pixels, size in rgb])


def test_cores_are_given_back_also_after_an_error():
    before = os.sched_getaffinity(0)

    def fail() -> None:
        with pinned() as core:
            assert os.sched_getaffinity(0) == {core}
            raise KeyError(core)

    with pytest.raises(KeyError):
        fail()
    assert os.sched_getaffinity(0) == before


def test_bench_prints_one_object_last_and_leaves_nothing(tmp_path, capsys):
    job = tmp_path / "job.yaml"
    job.write_text(json.dumps(SMALL))
    before = os.sched_getaffinity(0)
    folder = tmp_path / "data"
    assert main(["bench", str(job), "--scenes", "3", "--folder", str(folder), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert figures["rounds"] == 2 and figures["scenes"] == 3
    for name in ("script_plain", "script_same_look"):
        ratio = figures["others"][name]["ratio"]
        assert ratio["least"] <= ratio["median"] <= ratio["most"]
        assert {"physics", "scene", "render", "projection", "write"} <= set(figures["others"][name]["stages_ms"])
    assert {"render", "encode", "write", "commit", "physics"} <= set(figures["ours"]["stages_ms"])
    assert os.sched_getaffinity(0) == before
    assert list(folder.iterdir()) == []
