"""The board's body, against OpenCV's own picture of the same board."""

import cv2
import numpy as np
import pytest
import trimesh

from schemas.job.captures import Board
from workers.capture.simulate.photograph import THICKNESS_M, board_body, marker_bits


def ink_at(shape, points):
    """[N] bool: whether the point [N, 2] of the print lies in a face of ink."""
    ink = shape.parts[1]
    corners = ink.vertices[ink.faces][:, :, :2]
    low, high = corners.min(axis=1), corners.max(axis=1)
    return np.array([((low < p) & (p < high)).all(axis=1).any() for p in points])


@pytest.mark.parametrize(
    "board",
    [Board(), Board(columns=3, rows=2, dictionary="DICT_6X6_250", first_id=17, width_m=0.3, height_m=0.2, gap_m=0.011)],
)
def test_the_print_is_opencvs_picture_of_the_board(board):
    """OpenCV draws its GridBoard with the first marker at the top left, as ours has it."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    ids = np.arange(board.columns * board.rows) + board.first_id
    theirs = cv2.aruco.GridBoard((board.columns, board.rows), board.marker_m, board.gap_m, dictionary, ids)
    px_per_m = 2000
    width = board.columns * (board.marker_m + board.gap_m) - board.gap_m
    height = board.rows * (board.marker_m + board.gap_m) - board.gap_m
    size = (round(width * px_per_m), round(height * px_per_m))
    picture = theirs.generateImage(size, marginSize=0, borderBits=1)
    bits = dictionary.markerSize + 2
    middles = (np.arange(bits) + 0.5) / bits * board.marker_m
    columns = (np.arange(board.columns)[:, None] * (board.marker_m + board.gap_m) + middles).ravel()
    rows = (np.arange(board.rows)[:, None] * (board.marker_m + board.gap_m) + middles).ravel()
    x, y = np.meshgrid(columns, rows)
    black = picture[(y * px_per_m).astype(int), (x * px_per_m).astype(int)] < 128
    points = np.stack([x - 0.5 * width, 0.5 * height - y], axis=-1).reshape(-1, 2)
    assert np.array_equal(ink_at(board_body(board), points), black.ravel())
    assert 0.3 < black.mean() < 0.9


def test_the_body_is_closed_and_its_faces_look_outwards():
    shape = board_body(Board())
    mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=True)
    assert mesh.volume == pytest.approx(0.6 * 0.4 * THICKNESS_M)
    assert mesh.bounds.tolist() == pytest.approx(np.array([[-0.3, -0.2, -THICKNESS_M], [0.3, 0.2, 0.0]]))
    top = mesh.triangles_center[:, 2] == 0.0
    assert mesh.area_faces[top].sum() == pytest.approx(0.24)
    assert (mesh.face_normals[top][:, 2] > 0.999).all()


def test_ink_covers_its_share_of_the_print():
    board = Board()
    ink = board_body(board).parts[1]
    area = trimesh.Trimesh(ink.vertices, ink.faces, process=False).area
    cell = board.marker_m / marker_bits(board).shape[1]
    assert area == pytest.approx(marker_bits(board).sum() * cell**2)


def test_a_print_that_is_too_large_is_larger_in_every_length():
    nominal, large = board_body(Board()), board_body(Board(measured_ruler_m=0.204))
    assert np.allclose(large.vertices[:, :2], 1.02 * nominal.vertices[:, :2], atol=1e-15)
