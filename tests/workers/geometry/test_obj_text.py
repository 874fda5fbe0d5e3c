"""Convex parts as OBJ, read back by the format's rules."""

import numpy as np

from workers.geometry.obj_text import obj_of

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
    parts = [TETRAHEDRON / 3.0, TETRAHEDRON[[0, 1, 2, 3, 3]] + 7.0, TETRAHEDRON - 1e-5]
    objects = read(obj_of(parts))
    assert list(objects) == ["part0", "part1", "part2"]
    for part, (vertices, faces) in zip(parts, objects.values(), strict=True):
        np.testing.assert_array_equal(np.float32(vertices), np.float32(part))
        assert faces == [[0, k, k + 1] for k in range(1, len(part) - 1)]


def test_nine_digits_are_written():
    assert obj_of([np.full((3, 3), 1.0 / 3.0)]).count(b"0.333333333") == 9
