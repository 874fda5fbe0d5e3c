"""PLY files in text and in both byte orders: lists of any lengths, what ends early, and what this project writes."""

import io

import numpy as np
import pytest
import trimesh

from workers.door.meshes.ply import encode_ply, parse_ply

POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.1], [2, 0, 5e-9]], np.float32)
MIXED = [[0, 1, 2, 3], [1, 4, 2], [0, 1, 3]]
ALIKE = [row[:3] for row in MIXED]
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def ply(encoding, faces, numbers=(7, 8, 9)):
    """Points, faces that have a number before and after their list, and an element of nothing but numbers."""
    order = ORDERS[encoding]
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    face = "property uchar kind\nproperty list uchar int vertex_indices\nproperty short number\n"
    head = f"ply\nformat {encoding} 1.0\ncomment x\nelement vertex 5\n{axes}element face {len(faces)}\n{face}"
    head += f"element more {len(numbers)}\nproperty double d\nend_header\n"
    if not order:
        rows = [*POINTS.tolist(), *([k, len(row), *row, -k] for k, row in enumerate(faces)), *([n] for n in numbers)]
        return (head + "".join(" ".join(map(repr, row)) + "\n" for row in rows)).encode()
    body = POINTS.astype(f"{order}f4").tobytes()
    for k, row in enumerate(faces):
        body += bytes([k, len(row)]) + np.array(row, f"{order}i4").tobytes() + np.array(-k, f"{order}i2").tobytes()
    return head.encode() + body + np.array(numbers, f"{order}f8").tobytes()


@pytest.mark.parametrize("faces", [MIXED, ALIKE, []], ids=["mixed", "alike", "none"])
@pytest.mark.parametrize("encoding", ORDERS)
def test_every_column_is_what_was_written(encoding, faces):
    elements = parse_ply(ply(encoding, faces))
    assert list(elements) == ["vertex", "face", "more"]
    assert np.array_equal(np.column_stack([elements["vertex"][axis] for axis in "xyz"]), POINTS)
    face = elements["face"]
    assert [list(row) for row in face["vertex_indices"]] == faces
    assert face["kind"].tolist() == list(range(len(faces))) == [-k for k in face["number"].tolist()]
    assert elements["more"]["d"].tolist() == [7, 8, 9]


@pytest.mark.parametrize("encoding", ORDERS)
def test_a_file_that_ends_early_or_promises_too_much_is_an_error(encoding):
    whole = ply(encoding, MIXED)
    for share in (0.3, 0.7, 0.95):
        with pytest.raises((ValueError, LookupError)):
            parse_ply(whole[: int(share * len(whole))])
    for before, after in (
        (b"element vertex 5", b"element vertex 5000"),
        (b"format ", b"format un"),
        (b"end_", b"and_"),
    ):
        with pytest.raises((ValueError, LookupError)):
            parse_ply(whole.replace(before, after))


def test_numbers_that_their_type_cannot_hold_are_an_error():
    for word in ("300", "-1", "1.5", "nan", "x"):
        text = f"ply\nformat ascii 1.0\nelement vertex 1\nproperty uchar red\nend_header\n{word}\n"
        with pytest.raises(ValueError, match=r"no uint8|could not convert"):
            parse_ply(text.encode())


def test_what_is_written_is_read_back_here_and_by_another_library():
    vertex = dict(zip("xyz", POINTS.T, strict=True)) | {"views": np.arange(5, dtype=np.uint16)}
    data = encode_ply("metres", vertex=vertex, face={"vertex_indices": np.array(ALIKE, np.int32)})
    elements = parse_ply(data)
    assert all(np.array_equal(elements["vertex"][name], column) for name, column in vertex.items())
    mesh = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False)
    assert np.array_equal(mesh.vertices, POINTS) and mesh.faces.tolist() == ALIKE
