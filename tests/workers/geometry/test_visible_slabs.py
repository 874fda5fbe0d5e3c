"""What is visible from the axis of outlines that are easy to see."""

import numpy as np
import pytest
import shapely

from workers.geometry.lathe_decomposition import is_covered, ring_points, stack_slabs, trace_visible_border

CONE = np.array([(0.0, 0.0), (2.0, 0.0), (0.0, 4.0)])
CUP = np.array([(0.0, 0.0), (3.0, 0.0), (3.0, 5.0), (2.0, 5.0), (2.0, 1.0), (0.0, 1.0)])
SPOOL = np.array([(0.0, 0.0), (3.0, 0.0), (3.0, 1.0), (1.0, 1.0), (1.0, 4.0), (3.0, 4.0), (3.0, 5.0), (0.0, 5.0)])


def visible(outline) -> shapely.Polygon:
    border = trace_visible_border(outline)
    return shapely.Polygon([outline[0], *((ring.radius, ring.height) for ring in border), outline[-1]])


def test_a_cone_is_visible_as_a_whole_and_of_a_cup_only_the_bottom():
    assert visible(CONE).equals(shapely.Polygon(CONE))
    assert visible(CUP).area == pytest.approx(3.0)
    assert is_covered(CONE, visible(CONE), 1e-3)
    assert not is_covered(CUP, visible(CUP), 1e-3)


def test_what_lies_behind_the_side_nearest_to_the_axis_is_not_visible():
    collar = np.array([(0, 0), (3, 0), (3, 4), (2, 4), (2, 1), (1, 1), (1, 5), (0, 5)], dtype=np.float64)
    assert visible(collar).area == pytest.approx(3.0 * 1.0 + 1.0 * 4.0)


def test_a_spool_is_three_bodies_and_a_cone_is_one():
    stacks = stack_slabs(trace_visible_border(SPOOL), SPOOL[None], visible(SPOOL), 1e-3, 0.1)
    assert [(stack[0].height, stack[-1].height) for stack in stacks] == [(0.0, 1.0), (1.0, 4.0), (4.0, 5.0)]
    assert len(stack_slabs(trace_visible_border(CONE), CONE[None], visible(CONE), 1e-3, 0.1)) == 1


@pytest.mark.parametrize(("depth", "bodies"), [(0.9e-3, 1), (1.1e-3, 3)])
def test_a_groove_parts_a_body_if_it_is_deeper_than_the_tolerance_in_any_outline(depth, bodies):
    grooved = SPOOL.copy()
    grooved[3:5, 0] = 3.0 - depth
    smooth = np.array([(3.0 if radius > 0.0 else 0.0, height) for radius, height in grooved])
    stacks = stack_slabs(trace_visible_border(grooved), np.stack([smooth, grooved]), visible(grooved), 1e-3, 0.1)
    assert len(stacks) == bodies


def test_a_thin_neck_reaches_into_its_wider_neighbours():
    neck = SPOOL.copy()
    neck[4:, 1] -= 2.9
    stacks = stack_slabs(trace_visible_border(neck), neck[None], visible(neck), 1e-3, 0.5)
    heights = [ring.height for ring in stacks[1]]
    assert heights == pytest.approx([1.0, 1.1, 0.5, 1.6])
    assert [ring.scale for ring in stacks[1]] == [1.0, 1.0, 0.5, 0.5]


def test_rings_are_copies_of_the_outline_in_every_column():
    angles = np.arange(4) * np.pi / 2
    columns = np.stack(
        [np.stack([r * np.cos(angles), r * np.sin(angles), np.full(4, z)], axis=1) for r, z in CONE], axis=0
    )
    points = ring_points(columns, CONE, trace_visible_border(CONE))
    assert np.hypot(points[:, 0], points[:, 1]) == pytest.approx([2.0] * 4 + [0.0] * 4)
    assert points[:, 2] == pytest.approx([0.0] * 4 + [4.0] * 4)
