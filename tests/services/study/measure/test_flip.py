"""FLIP: its formula where an image has one colour, and that it is a function of two images."""

import itertools
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from services.study.colour import flip_between

D = 6 / 29
"""Of CIELAB."""


def plain(colour, shape=(40, 50)):
    return np.broadcast_to(np.array(colour, np.uint8), (*shape, 3))


def noise(scale, seed=3):
    rng = np.random.default_rng(seed)
    return np.clip(128 + scale * rng.standard_normal((60, 80, 3)), 0, 255).astype(np.uint8)


def hunt_lab(rgb) -> np.ndarray:
    """CIELAB of an sRGB colour under D65, its chroma scaled by lightness (Hunt), as FLIP's authors write it."""
    s = np.array(rgb) / 255
    light = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    matrix = np.array(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    )
    x, y, z = (t ** (1 / 3) if t > D**3 else t / (3 * D**2) + 4 / 29 for t in matrix @ light / matrix.sum(axis=1))
    lightness = 116 * y - 16
    return np.array([lightness, 0.01 * lightness * 500 * (x - y), 0.01 * lightness * 200 * (y - z)])


def flip_of_colours(a, b) -> float:
    """FLIP where two images have one colour each, so no features: HyAB to the power 0.7, then 0.4 of green and blue's maps
    to 0.95 (Andersson et al. 2020, sections 4.1.2 and 4.1.3)."""

    def distance(p, q):
        d = hunt_lab(p) - hunt_lab(q)
        return (abs(d[0]) + np.hypot(d[1], d[2])) ** 0.7

    largest, found = distance((0, 255, 0), (0, 0, 255)), distance(a, b)
    knee = 0.4 * largest
    return 0.95 * found / knee if found < knee else 0.95 + 0.05 * (found - knee) / (largest - knee)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ((0, 0, 0), (255, 255, 255)),
        ((0, 255, 0), (0, 0, 255)),
        ((128, 128, 128), (140, 128, 120)),
        ((200, 30, 40), (190, 60, 40)),
        ((12, 14, 10), (14, 12, 10)),
    ],
)
def test_between_two_plain_images_flip_is_its_formula(a, b):
    expected = flip_of_colours(a, b)
    assert flip_between(plain(a), plain(b)) == pytest.approx(expected, rel=2e-3)
    assert flip_between(plain(b), plain(a)) == pytest.approx(expected, rel=2e-3)


def test_an_image_against_itself_is_0_and_black_against_white_almost_1():
    assert flip_between(noise(40), noise(40).copy()) == 0.0
    assert 0.96 < flip_between(plain((0, 0, 0)), plain((255, 255, 255))) < 1.0


def test_the_more_noise_is_added_the_larger_the_error():
    errors = [
        flip_between(plain((128, 128, 128), (60, 80)), noise(scale)) for scale in (0.0, 2.0, 5.0, 10.0, 20.0, 40.0)
    ]
    assert errors[0] == 0.0
    assert all(a < 0.8 * b for a, b in itertools.pairwise(errors))


def test_images_of_two_sizes_or_of_another_kind_are_refused_and_end_no_process():
    image = noise(10)
    for other in (image[:-1], image[..., :2], image[..., 0], image.astype(np.float32)):
        with pytest.raises(ValueError, match="uint8 of one size"):
            flip_between(image, other)
    with pytest.raises(ValueError, match="uint8 of one size"):
        flip_between(image.astype(np.float32), image)


def test_flip_prints_nothing_writes_nothing_and_is_the_same_on_any_number_of_threads(tmp_path):
    code = (
        "import numpy as np; from services.study.colour import flip_between;"
        "rng = np.random.default_rng(0); a = rng.integers(0, 256, (150, 170, 3), dtype=np.uint8);"
        "b = np.clip(a + rng.normal(0, 20, a.shape), 0, 255).astype(np.uint8);"
        "print(*{flip_between(a, b).hex() for _ in range(3)})"
    )
    root = str(Path(__file__).parents[4])
    said = [
        subprocess.run(
            [sys.executable, "-c", code],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": threads, "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            text=True,
            check=True,
        )
        for threads in ("1", "3")
    ]
    assert said[0].stdout == said[1].stdout and len(said[0].stdout.split()) == 1
    assert said[0].stderr == said[1].stderr == ""
    assert list(tmp_path.iterdir()) == []
