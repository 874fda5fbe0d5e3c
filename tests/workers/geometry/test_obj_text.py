"""Convex parts as OBJ, read back by the format's rules."""

import numpy as np
import pytest

from workers.physics.bullet import DECIMALS, obj_of

TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def read(text):
    """(vertices, faces) by object. A negative number of a face counts back from the last vertex before it."""
    objects, vertices = {}, []
    for line in text.decode("ascii").splitlines():
        kind, *words = line.split()
        if kind == "o":
            begin, own = len(vertices), objects.setdefault(words[0], ([], []))
        elif kind == "v":
            vertices.append([float(word) for word in words])
            own[0].append(vertices[-1])
        elif kind == "f":
            own[1].append([len(vertices) + int(word) - begin for word in words])
    return objects


def test_a_reader_finds_every_part_with_its_own_vertices():
    parts = [np.round(TETRAHEDRON / 3.0, DECIMALS), TETRAHEDRON[[0, 1, 2, 3, 3]] + 7.0, TETRAHEDRON - 1e-5]
    objects = read(obj_of(parts))
    assert list(objects) == ["part0", "part1", "part2"]
    for part, (vertices, faces) in zip(parts, objects.values(), strict=True):
        np.testing.assert_array_equal(np.float32(vertices), np.float32(part))
        assert faces == [[0, k, k + 1] for k in range(1, len(part) - 1)]


@pytest.mark.parametrize("size_m", [1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 0.1, 1.0, 9.9, 11.0, 2e4])
def test_coordinates_are_written_as_python_writes_them_with_nine_digits(size_m):
    part = np.round(np.random.default_rng(0).uniform(-size_m, size_m, (500, 3)), DECIMALS)
    lines = [line for line in obj_of([part]).decode("ascii").splitlines() if line.startswith("v")]
    assert lines == ["v " + " ".join(f"{value:.9g}" for value in point) for point in part.tolist()]


def test_zeros_at_the_end_are_left_out_and_the_sign_of_zero_is_not():
    part = np.array([[0.0, -0.0, 1.0], [0.1, -2.5, 1e-4], [9.9e-5, 1e-5, -1.2e-7]])
    expected = b"o part0\nv 0 -0 1\nv 0.1 -2.5 0.0001\nv 9.9e-05 1e-05 -1.2e-07\nf -3 -2 -1\n"
    assert obj_of([part]) == expected
