"""Errors of the mirror pose: d_z against the nearest visible point, and the agreement of the views."""

import numpy as np
import pytest
import trimesh
from tests.services.study.label_views import (
    TOP_Z,
    block,
    camera_above,
    measure,
    pair_of,
    seen_of_block,
    table_and,
    thing,
    view,
)

from schemas.scene.view import Agreement
from tests.kit.shapes import box
from workers.geometry.camera import look_at
from workers.scene.pairs import mirror_pose


def ball(radius=0.1, at=(0.0, 0.0)):
    """Its nearest point to the camera above is a vertex, at 2 m less twice the radius."""
    mesh = trimesh.creation.uv_sphere(radius=radius, count=(64, 64))
    mesh.apply_translation((*at, radius))
    return mesh


def test_d_z_12_mm_behind_a_ball_s_front_sets_the_mirror_camera_12_mm_off(seen):
    first = view("input", camera_above(), *seen)
    found = measure(table_and(ball()), pair_of(first, first, d_z_m=1.8 + 0.012))
    assert found["mirror_mm"] == pytest.approx(12.0, abs=1e-3)
    found = measure(table_and(ball()), pair_of(first, first, d_z_m=1.8 - 0.003))
    assert found["mirror_mm"] == pytest.approx(3.0, abs=1e-3)


def test_the_front_is_a_corner_between_all_rays():
    """A needle's point."""
    needle = trimesh.creation.cone(radius=0.05, height=0.3, sections=7)
    first = view("input", camera_above(), *seen_of_block(camera_above()))
    found = measure(table_and(needle), pair_of(first, first, d_z_m=1.7))
    assert found["mirror_mm"] == pytest.approx(0.0, abs=1e-6)


def test_what_is_outside_the_picture_or_hidden_is_not_the_front():
    """A taller block beside the picture; and a block whose nearest part stands under a wide table."""
    first = view("input", camera_above(), *seen_of_block(camera_above()))
    beyond = box(0.2, 0.2, 0.6, (0.7, 0.0, 0.3))
    both = trimesh.util.concatenate([block(), beyond])
    assert measure(table_and(both), pair_of(first, first, d_z_m=1.8))["mirror_mm"] == pytest.approx(0.0, abs=1e-6)
    roof = box(0.2, 0.4, 0.01, (0.15, 0.0, 0.5))
    under = trimesh.util.concatenate([block(0.05), box(0.05, 0.05, 0.4, (0.15, 0.0, 0.2))])
    things = (thing(2, trimesh.util.concatenate([box(4, 4, 0.02, (0, 0, -0.01)), roof])), thing(3, under))
    assert measure(things, pair_of(first, first, d_z_m=1.8))["mirror_mm"] == pytest.approx(0.0, abs=1e-6)


def test_the_mirror_camera_moves_along_the_input_s_axis_by_what_d_z_is_off():
    T = look_at(np.array([1.2, -0.7, 1.9]), np.zeros(3))
    right, off = mirror_pose(T, 2.0), mirror_pose(T, 2.0125)
    assert off[:3, 3] - right[:3, 3] == pytest.approx(0.0125 * T[:3, 2])
    assert np.array_equal(off[:3, :3], right[:3, :3])


def test_of_several_pairs_the_worst_is_told(seen):
    first = view("input", camera_above(), *seen)
    pairs = [
        pair_of(first, first, d_z_m=TOP_Z + off, agreement=Agreement(median, 1.0, 900, 0.0))
        for off, median in ((0.001, 0.3), (-0.004, 0.2), (0.002, None))
    ]
    found = measure(table_and(block()), *pairs)
    assert found["mirror_mm"] == pytest.approx(4.0, abs=1e-3)
    assert found["agreement_mm"] == 0.3
