"""Lights and maps of light: what a job may ask for, files from outside by kind, and what is drawn."""

import cv2
import numpy as np
import OpenEXR
import pytest

from schemas.base import Counts, Range
from schemas.errors import AssetSourceError, JobError, MeshError
from schemas.job.look import BUILT_IN, Environment, Lights
from services.job.job_file import validate_job
from tests.kit.tiers import first_of
from workers.assets.look import environment
from workers.assets.look.environment import load_map, open_maps
from workers.assets.look.lights import draw_environment, draw_lights, planckian_rgb
from workers.capture.results import open_sources
from workers.geometry.irradiance import LUMINANCE


@pytest.fixture(autouse=True)
def no_cache(monkeypatch, tmp_path):
    monkeypatch.setattr(environment, "cache_folder", lambda name: tmp_path / "cache" / name)


def grey(height=32, width=64):
    return np.linspace(0.2, 0.6, height * width * 3, dtype=np.float32).reshape(height, width, 3)


def exr(path, pixels, names="RGB"):
    channels = {name: np.ascontiguousarray(pixels[..., n]) for n, name in enumerate(names)}
    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(head, channels).write(str(path))


def holding(value):
    def write(path):
        pixels = grey()
        pixels[3, 5] = value
        exr(path, pixels)

    return write


def headed(width, height):
    """A head of this size, and nothing behind it: it must be judged before anything is decoded."""
    return lambda path: path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width))


def cut(path):
    cv2.imwrite(str(path), grey())
    path.write_bytes(path.read_bytes()[:900])


REFUSED = {
    "nan.exr": (holding(np.nan), r"nan\.exr holds what is no finite number: 3 of 6144 values, the first \[nan.*row 3, column 5"),
    "inf.exr": (holding(np.inf), "is no finite number"),
    "negative.exr": (holding(-0.5), r"is negative: 3 of 6144 .*\[-0\.5.*repair it, or take it out"),
    "beyond.exr": (holding(1e20), r"is above 1e\+10"),
    "black.exr": (lambda path: exr(path, 0 * grey()), "is black: take it out"),
    "huge.hdr": (headed(16384, 8192), "is 16384 x 8192, and at most 8192 x 4096 are read: scale it down"),
    "square.hdr": (headed(64, 64), "is 64 x 64, and an equirectangular map is twice as wide as high"),
    "turned.hdr": (lambda p: p.write_bytes(b"#?RADIANCE\n\n+Y 32 +X 64\n"), "has its rows in another order"),
    "depth.exr": (lambda path: exr(path, grey(), "ZAB"), "has the channels .*, and must have R, G and B"),
    "text.hdr": (lambda path: path.write_text("no picture"), "neither Radiance HDR nor OpenEXR"),
    "cut.hdr": (cut, r"cut\.hdr .*cut or altered: copy it again"),
    "cut.exr": (lambda p: (exr(p, grey()), p.write_bytes(p.read_bytes()[:700])), r"cut\.exr cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("name", first_of(REFUSED, 5))
def test_a_map_that_cannot_be_used_is_refused_by_name_before_the_run(name, tmp_path):
    write, message = REFUSED[name]
    write(tmp_path / name)
    exr(tmp_path / "good.exr", grey())
    with pytest.raises(AssetSourceError, match=message) as refused:
        open_maps(".", tmp_path)
    assert str(refused.value).startswith(f"look.environment.folder: {tmp_path / name}")


@pytest.mark.parametrize(
    ("files", "message"),
    [([], "has no maps"), (["a.png"], r"no maps \(\.hdr, \.exr\) but a\.png"), (None, "cannot be read: No such file")],
)
def test_a_folder_without_maps_is_refused(files, message, tmp_path):
    folder = tmp_path / "maps"
    if files is not None:
        folder.mkdir()
        for name in files:
            (folder / name).write_bytes(b"x")
    with pytest.raises(AssetSourceError, match=message):
        open_maps("maps", tmp_path)


def test_what_rounding_leaves_below_0_and_a_sun_of_10_6_are_light_as_any(tmp_path):
    pixels = grey()
    pixels[0, 0], pixels[8, 32] = -1e-5, 1e6
    exr(tmp_path / "a.exr", pixels)
    cv2.imwrite(str(tmp_path / "b.HDR"), pixels[..., ::-1])
    maps = open_maps(".", tmp_path)
    assert [source.name for source in maps] == ["a.exr", "b.HDR"]
    for source in maps:
        light = load_map(source)
        assert light.radiance.shape == (512, 1024, 3) and np.isfinite(light.radiance).all()
        ((towards,), (rgb,)) = (
            light.towards,
            light.colors,
        )  # half a turn and a quarter of the way down: towards +x and up
        assert towards == pytest.approx([np.cos(np.pi / 4), 0.0, np.sin(np.pi / 4)], abs=0.08)
        assert rgb == pytest.approx(rgb.mean(), rel=0.02)


def test_a_map_that_changes_under_a_run_is_told_and_a_datasets_digest_covers_it(tmp_path, monkeypatch):
    exr(tmp_path / "a.exr", grey())
    job = validate_job({"name": "a", "look": {"environment": {"folder": str(tmp_path)}}}, "a test")
    before = open_sources(job, tmp_path)
    (source,) = before.maps
    exr(tmp_path / "a.exr", 2.0 * grey())
    assert (
        open_sources(job, tmp_path).digest
        != before.digest
        != open_sources(validate_job({"name": "a"}, "t"), tmp_path).digest
    )
    monkeypatch.setattr(environment, "cache_folder", lambda name: None)
    with pytest.raises(MeshError, match="has changed since the run began"):
        load_map(source)


def test_lights_are_drawn_within_their_ranges_and_add_up_to_the_total():
    spec = Lights(number=Counts(2, 6), share=Range(0.3, 0.9), total=Range(0.9, 1.0), temperature_k=Range(3000, 9000))
    counts, shares = set(), []
    for seed in range(60):
        drawn = draw_lights(np.random.default_rng(seed), spec)
        levels = [float(np.dot(light.color, LUMINANCE)) * light.direction[2] for light in drawn.lights]
        counts.add(len(levels))
        rest = drawn.ambient[0]
        assert 0.9 * 0.95 - 1e-9 < sum(levels) + rest < 0.95 + 1e-9
        assert levels[0] == pytest.approx(sum(levels[1:]))
        shares.append(sum(levels) / (sum(levels) + rest))
        for light, kelvin in zip(drawn.lights, drawn.temperatures_k, strict=True):
            assert 30 <= np.degrees(np.arcsin(light.direction[2])) <= 75 and 1 <= np.degrees(light.size_rad) <= 8
            assert 3000 <= kelvin <= 9000
            assert abs(kelvin - 6540) < 30 or (light.color[0] > light.color[2]) == (kelvin < 6540)
    assert counts == {2, 3, 4, 5, 6} and 0.3 < min(shares) < 0.4 and 0.8 < max(shares) < 0.9
    every = {draw_environment(np.random.default_rng(n), Environment(), ()).source.name for n in range(60)}
    assert every == set(BUILT_IN)


@pytest.mark.parametrize("kelvin", [1700, 2500, 4000, 6500, 10_000, 25_000])
def test_a_colour_temperature_is_that_of_plancks_law(kelvin):
    """Through the CIE's 1931 observer as Wyman, Sloan and Shirley 2013 fit it, equation 4."""
    nm = np.arange(380.0, 781.0)

    def lobe(at, left, right):
        return np.exp(-0.5 * ((nm - at) * np.where(nm < at, left, right)) ** 2)

    x = 0.362 * lobe(442.0, 0.0624, 0.0374) + 1.056 * lobe(599.8, 0.0264, 0.0323) - 0.065 * lobe(501.1, 0.0490, 0.0382)
    y = 0.821 * lobe(568.8, 0.0213, 0.0247) + 0.286 * lobe(530.9, 0.0613, 0.0322)
    z = 1.217 * lobe(437.0, 0.0845, 0.0278) + 0.681 * lobe(459.0, 0.0385, 0.0725)
    power = nm**-5 / np.expm1(1.438777e7 / (nm * kelvin))
    XYZ = np.array([(power * bar).sum() for bar in (x, y, z)])
    to_rgb = np.linalg.inv([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    expected = np.maximum(to_rgb @ XYZ, 0.0)
    assert planckian_rgb(kelvin) == pytest.approx(expected / (expected @ LUMINANCE), rel=0.03, abs=0.02)


@pytest.mark.parametrize(
    ("look", "message"),
    [
        ({"lights": {"number": [0, 3]}}, r"look.lights.number: \[0, 3\]: write a whole number from 1 to 6"),
        ({"lights": {"elevation_deg": [-5, 40]}}, r"look.lights.elevation_deg: \[-5, 40\]: must lie within 1 and 90"),
        ({"lights": {"temperature_k": 500}}, "must lie within 1700 and 25000"),
        ({"environment": {"built_in": []}}, "look.environment.built_in"),
        ({"environment": {"built_in": ["moon"]}}, "clear_sky"),
    ],
)
def test_a_look_that_cannot_be_is_refused_by_its_key(look, message):
    with pytest.raises(JobError, match=message):
        validate_job({"name": "a", "look": look}, "a test")
