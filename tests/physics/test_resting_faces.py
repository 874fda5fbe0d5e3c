"""On which face a tumbling body ends: production, against a quasi-static prediction and against finer steps.

A single drop that tumbles does not converge, because it is chaotic; the shares over many drops do.
"""

import functools
import math

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from scipy.stats import chi2_contingency

from schemas.base import Array
from schemas.job.job import Job
from schemas.job.physics import Physics
from schemas.scene.shape import Asset
from tests.kit.shapes import asset_of, box, table
from tests.physics.room import PHYSICS, physics
from tests.physics.settling import settle_single
from workers.geometry.frames import pose, rotation_between, transform
from workers.geometry.hull import convex_hull
from workers.physics.support import DOWN, SAME_PLANE_M, place_table, support_margin
from workers.scene.chance import SceneChance
from workers.scene.draw.plan import draw_start

TABLE = place_table(table())
SIGNIFICANCE = 0.001
"""Of the chi-squared tests: with fixed starts it either holds or not, and this leaves room for one unlucky draw."""

BIAS = 0.1
"""How far the shares may lie from the quasi-static prediction (half the sum of the differences). A body that drops keeps
some of its speed over the edges of faces that hold it by a low sill; those lose most of their share to deeper ones. It
would take dissipation without end to make the prediction exact, so that this is a bound on its error and not on ours."""

SAMPLES = [pytest.param(100, 3840, id="100 drops"), pytest.param(600, 7680, id="600 drops", marks=pytest.mark.slow)]
"""Drops, and the finest step's rate, Hz."""

FIRST_FINE = 100_000
"""Drops at the finest step have starts of their own, so that the two samples are independent."""

SAME_PLANE = 1e-9


@functools.cache
def body(name: str) -> Asset:
    """Bodies of unequal faces: a box, and the hull of 9 points on an ellipsoid whose mass lies off its middle."""
    if name == "box":
        return asset_of(box(0.06, 0.09, 0.14))
    points = np.random.default_rng(np.random.SeedSequence(0)).standard_normal((9, 3))
    points *= np.array([0.05, 0.06, 0.07]) / np.linalg.norm(points, axis=1)[:, None]
    return asset_of(trimesh.convex.convex_hull(points))


def solid_angle(a: Array, b: Array, c: Array) -> float:
    """Of a triangle seen from the origin (Van Oosterom and Strackee 1983, IEEE Trans. Biomed. Eng. 30, equation 8)."""
    lengths = [float(np.linalg.norm(p)) for p in (a, b, c)]
    across = float(np.dot(a, np.cross(b, c)))
    along = math.prod(lengths) + (a @ b) * lengths[2] + (b @ c) * lengths[0] + (c @ a) * lengths[1]
    return abs(2.0 * math.atan2(across, along))


def predict_shares(asset: Asset) -> dict[int, tuple[Array, float]]:
    """By stable face: its outward normal in the object's frame, and the share of quasi-static drops that end on it.

    A body that is let down without speed in a uniform rotation lands on the face that the vertical through its centre
    of mass crosses, whose share is its solid angle, and rolls on over the edge beyond which the centre of mass is
    farthest, until a face has it inside (Goldberg, Mirtich, Zhuang, Craig, Carlisle and Canny 1999, Part pose
    statistics, IEEE Trans. Robotics and Automation 15 (5)).
    """
    hull = ConvexHull(asset.shape.vertices - asset.mass.com)
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    same = (normals @ normals.T > 1 - SAME_PLANE) & (np.abs(offsets[:, None] - offsets) < SAME_PLANE)
    face = np.argmax(same, axis=1)  # triangles of one plane go by the first of them
    ends: dict[int, Array] = {}
    shares: dict[int, float] = {}
    for triangle in range(len(hull.simplices)):
        end = _roll(hull, face, triangle)
        shares[end] = shares.get(end, 0.0) + solid_angle(*hull.points[hull.simplices[triangle]]) / (4 * math.pi)
        ends[end] = normals[end]
    return {end: (ends[end], shares[end]) for end in sorted(shares)}


def _roll(hull: ConvexHull, face: Array, triangle: int) -> int:
    now = int(face[triangle])
    while (after := _over_edge(hull, face, now)) is not None:
        now = after
    return now


def _over_edge(hull: ConvexHull, face: Array, now: int) -> int | None:
    """The neighbour onto which a body on this face rolls; None where it stands."""
    foot = -hull.equations[now, 3] * hull.equations[now, :3]  # the centre of mass, the origin, in the face's plane
    farthest, after = 0.0, None
    for triangle in np.flatnonzero(face == now):
        corners = hull.points[hull.simplices[triangle]]
        for k, neighbour in enumerate(hull.neighbors[triangle]):  # the k-th lies across from the k-th corner
            if face[neighbour] == now:
                continue
            a, b = np.delete(corners, k, axis=0)
            out = np.cross(b - a, hull.equations[now, :3])
            out *= np.sign(out @ (a - corners[k])) / np.linalg.norm(out)
            if (beyond := float(out @ (foot - a))) > farthest:
                farthest, after = beyond, int(face[neighbour])
    return after


@functools.cache
def drop_many(asset: Asset, settings: Physics, first: int, drops: int) -> Array:
    """How many of these drops, in uniform rotations through `settle`, end on each stable face."""
    job = Job.model_validate(
        {"name": "t", "start": {"pose": "tumbled", "offset_m": [-0.01, 0.01], "clearance_m": [0.001, 0.002]}}
    )
    normals = np.array([normal for normal, _ in predict_shares(asset).values()])
    counts = np.zeros(len(normals))
    for number in range(first, first + drops):
        rest = settle_single(draw_start(job.start, SceneChance(job.seed, number), asset, TABLE), TABLE, settings)
        alike = normals @ (rest.T_world_obj[:3, :3].T @ DOWN)
        assert alike.max() > 1 - 1e-6  # it stands on a face that can be stood on
        counts[np.argmax(alike)] += 1
    return counts


def is_stable(T_world_obj, hull, com) -> bool:
    """Whether the centre of mass stands over the hull's lowest face."""
    points = transform(T_world_obj, hull.vertices)
    face = points[points[:, 2] <= points[:, 2].min() + SAME_PLANE_M]
    return support_margin(face[:, :2], transform(T_world_obj, com[None, :])[0, :2]) > 0.0


@pytest.mark.parametrize("name", ["box", "hull"])
def test_predicted_shares_belong_to_faces_that_the_body_can_stand_on_and_add_up_to_one(name):
    asset = body(name)
    hull = convex_hull(asset.shape.vertices)
    shares = predict_shares(asset)
    assert sum(share for _, share in shares.values()) == pytest.approx(1.0)
    assert all(
        is_stable(pose(rotation_between(normal, DOWN), DOWN), hull, asset.mass.com) for normal, _ in shares.values()
    )
    assert name == "box" or len(shares) < len(hull.normals)  # some faces cannot be stood on


def test_the_box_has_the_solid_angles_of_its_rectangles():
    """4 asin(a b / sqrt((4 d^2 + a^2) (4 d^2 + b^2))) of sides a, b at the distance d (Khadjavi 1968, JOSA 58)."""
    sides = np.array([0.06, 0.09, 0.14])
    for normal, share in predict_shares(body("box")).values():
        k = int(np.argmax(np.abs(normal)))
        d2, (a, b) = sides[k] ** 2, np.delete(sides, k)
        exact = 4 * math.asin(a * b / math.sqrt((d2 + a * a) * (d2 + b * b))) / (4 * math.pi)
        assert share == pytest.approx(exact, rel=1e-9)


@pytest.mark.minute
@pytest.mark.parametrize(("drops", "fine_hz"), SAMPLES)
@pytest.mark.parametrize("name", ["box", "hull"])
def test_tumbling_drops_end_as_the_quasi_static_prediction_says_within_its_bias(name, drops, fine_hz, record_figure):
    asset = body(name)
    predicted = np.array([share for _, share in predict_shares(asset).values()])
    off = float(np.abs(drop_many(asset, PHYSICS, 0, drops) / drops - predicted).sum() / 2)
    noise = float(
        np.sqrt(predicted * (1 - predicted) / drops).sum() / 2
    )  # no less than what chance alone gives on average
    record_figure(f"resting faces, {name}, {drops} drops: off the prediction", "passed", off, BIAS + noise)
    assert off < BIAS + noise


@pytest.mark.minute
@pytest.mark.parametrize(("drops", "fine_hz"), SAMPLES)
@pytest.mark.parametrize("name", ["box", "hull"])
def test_tumbling_drops_end_as_they_do_with_the_finest_steps(name, drops, fine_hz, record_figure):
    asset = body(name)
    ours = drop_many(asset, PHYSICS, 0, drops)
    fine = drop_many(asset, physics(step_hz=fine_hz), FIRST_FINE, drops)
    p = alike(ours, fine)
    record_figure(f"resting faces, {name}, {drops} drops: p against {fine_hz} Hz", "passed", p, SIGNIFICANCE)
    assert p > SIGNIFICANCE


@pytest.mark.minute
def test_the_test_of_shares_notices_that_faces_were_swapped():
    ours = drop_many(body("hull"), PHYSICS, 0, 100)
    assert alike(ours, np.roll(ours, 1)) < SIGNIFICANCE


def alike(a: Array, b: Array) -> float:
    """The chance that counts of one distribution differ as much, by chi squared; rare faces are put together."""
    rare = a + b < 10  # expected counts of five in each sample
    table_of = np.array([[*counts[~rare], counts[rare].sum()] for counts in (a, b)])
    return float(chi2_contingency(table_of[:, table_of.sum(axis=0) > 0]).pvalue)
