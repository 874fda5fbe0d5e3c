"""The straightforward script makes the same images as ours; a small camera, because no time is asserted."""

import shutil

import cv2
import numpy as np
import pytest

from schemas.environment import FOR_SPEED
from schemas.errors import MachineError
from services.bench import script as bench_script
from services.bench.script import looks_of, start_script


def pictures(folder) -> dict[str, tuple[tuple[int, ...], str]]:
    """Shape and type of every PNG below a folder."""
    found = {}
    for path in folder.rglob("*.png"):
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert pixels is not None
        found[str(path.relative_to(folder))] = (pixels.shape, str(pixels.dtype))
    return found


@pytest.fixture(scope="module")
def looks(given, tmp_path_factory):
    """Folders with what the script makes of them, by look."""
    folder = tmp_path_factory.mktemp("looks")
    with start_script() as script:
        for look in ("plain", "same"):
            assert script.run(given, folder / look, look).scenes == len(given) == 4
    return {look: folder / look for look in ("plain", "same")}


def inputs(folder, content: str) -> list[np.ndarray]:
    """Input views of one kind."""
    paths = sorted(folder.glob(f"*/{content}[0-9]*[02468].png"))
    return [np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) for path in paths]


@pytest.mark.minute
@pytest.mark.parametrize("look", ["plain", "same"])
def test_script_and_ours_write_the_same_images(bench, looks, look):
    assert pictures(looks[look]) == pictures(bench[0].store.root)
    assert any({1, 2, 3} <= set(image.ravel()) for image in inputs(looks[look], "segment"))


@pytest.mark.minute
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


@pytest.mark.minute
def test_the_same_look_throws_shadows(bench, given, tmp_path):
    """On a floor of one colour, what is a fifth darker than most of it lies in a shadow."""
    regions = inputs(bench[0].store.root, "segment")
    for path in given:
        shutil.copytree(path.parent, tmp_path / path.parent.name)
        picture = tmp_path / path.parent.name / "floor.png"
        cv2.imwrite(str(picture), np.full((8, 8, 3), 128, np.uint8))
    plain_floors = [tmp_path / path.parent.name / path.name for path in given]
    with start_script() as script:
        script.run(plain_floors, tmp_path / "out", "same")
    dark = []
    for region, image in zip(regions, inputs(tmp_path / "out", "RGB"), strict=True):
        shade = image.mean(axis=2)[region == 1]
        dark.append(float((shade < 0.8 * np.median(shade)).mean()))
    assert sum(0.005 < share < 0.5 for share in dark) >= 2, dark


def test_only_the_raster_tier_has_a_same_look_to_be_compared_with(bench):
    job = bench[0].context.job
    flat = job.model_copy(update={"render": job.render.model_copy(update={"tier": "flat"})})
    assert list(looks_of(job)) == ["plain", "same"] and list(looks_of(flat)) == ["plain"]


def test_a_script_that_dies_says_why(tmp_path):
    with start_script() as script, pytest.raises(MachineError, match=r"the script ended.*No such file"):
        script.ask({"scene": str(tmp_path / "nothing.json"), "out": str(tmp_path), "look": "plain"})


def test_a_script_does_not_inherit_what_is_set_for_our_speed(monkeypatch):
    [(name, value)] = FOR_SPEED.items()
    monkeypatch.setenv("OTHER", "kept")
    for given, seen in ((value, None), ("glibc.cpu.hwcaps=-AVX2", "glibc.cpu.hwcaps=-AVX2")):
        monkeypatch.setenv(name, given)
        inherited = bench_script._plain_environment()
        assert (inherited.get(name), inherited["OTHER"]) == (seen, "kept")
