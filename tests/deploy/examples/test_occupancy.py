"""What the occupancy example gives a network, its baselines and its score, without PyTorch."""

import numpy as np
import occupancy
import pytest

from tests.deploy.examples.conftest import is_behind


@pytest.fixture(scope="module")
def shapes(pairs):
    return [(pair, occupancy.make_example(pair)) for pair in pairs]


def in_world(pair, q):
    """Points [N, 3] of the network's frame in the world, as the docstring has it: table top, level view, seen points."""
    away = pair.input.T_world_cam[:2, 2] / np.linalg.norm(pair.input.T_world_cam[:2, 2])
    x, y, z = 0.1 * q.T
    seen = np.median(pair.input.cloud("world").points[:, :2], axis=0)
    level = seen + np.outer(x, away) + np.outer(y, [-away[1], away[0]])
    return np.column_stack([level, z + pair.mesh(2).vertices[:, 2].max()])


def test_a_sample_in_the_frame_of_the_network_is_inside_where_the_resting_mesh_is_solid(shapes):
    for pair, one in shapes:
        world = in_world(pair, one.queries[:, :3].astype(float))
        solid = pair.mesh(welded=True).contains(world)
        assert 0.02 < solid.mean() < 0.9 and (solid == one.inside).mean() > 0.995
        assert one.seen.shape == (occupancy.SEEN, 3) and one.queries.shape == (2000, occupancy.FEATURES)
        distance = np.linalg.norm(in_world(pair, one.seen)[:, None] - pair.input.cloud("world").points, axis=2)
        assert distance.min(axis=1).max() < 1e-5


def test_the_shadow_is_what_a_ray_from_the_camera_meets_behind_the_object_and_a_box_lies_in_it(shapes):
    for pair, one in shapes:
        hidden = is_behind(pair, in_world(pair, one.queries[:400, :3].astype(float))) & (one.queries[:400, 2] > 0)
        assert (hidden == one.shadow[:400]).mean() > 0.9
        assert (one.turned <= one.shadow).all() and one.turned.any() and (one.turned < one.shadow).any()
        if pair.category == "box":
            assert one.shadow[one.inside].mean() > 0.9 and occupancy.iou(one.shadow, one.inside) > 0.5


def test_half_a_turn_takes_a_cylinder_to_itself():
    angle, height = np.random.default_rng(1).uniform(0, [[2 * np.pi], [0.3]], (2, 4000))
    cylinder = np.column_stack([0.1 + 0.2 * np.cos(angle), 0.2 * np.sin(angle) - 0.05, height])
    turned = occupancy.half_turn(cylinder, cylinder[cylinder[:, 0] < 0.1])
    assert np.abs(np.hypot(turned[:, 0] - 0.1, turned[:, 1] + 0.05) - 0.2).max() < 0.01
    assert np.abs(turned - cylinder)[:, :2].max() > 0.39 and np.array_equal(turned[:, 2], cylinder[:, 2])


def test_iou_is_one_for_the_truth_and_falls_when_answers_are_shuffled(shapes):
    none, every = np.zeros(2000, bool), np.ones(2000, bool)
    assert np.isnan(occupancy.iou(none, none)) and occupancy.iou(none, every) == 0
    for _, one in shapes:
        share = one.inside.mean()
        assert occupancy.iou(one.inside, one.inside) == 1 and occupancy.iou(every, one.inside) == share
        shuffled = np.random.default_rng(1).permutation(one.inside)
        independent = share / (2 - share)
        assert occupancy.iou(shuffled, one.inside) == pytest.approx(independent, abs=0.04)
