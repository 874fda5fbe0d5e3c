import numpy as np

from tests.workers.capture.depths import BOX
from tests.workers.capture.poses.captures import FINER, Virtual, make
from workers.capture.poses.joint import REACH_M, gather, match_patches, placed
from workers.capture.poses.observation import no_patches
from workers.capture.poses.terms import Shared

TRUTH, EVIDENCE = make(Virtual(views=6, camera=FINER))
PATCHES, VIEW = gather([o.object_patches for o in EVIDENCE.observations])
POSES = np.stack(TRUTH)


def test_pairs_are_of_two_views_near_each_other_and_on_one_face():
    found = match_patches(PATCHES, VIEW, POSES, Shared())
    a, b = found.pairs.T
    points, _ = placed(PATCHES, VIEW, POSES, Shared())
    assert len(found.pairs) > 200
    assert (VIEW[a] != VIEW[b]).all() and (a < b).all() and len(np.unique(found.pairs, axis=0)) == len(found.pairs)
    assert np.linalg.norm(points[a] - points[b], axis=1).max() <= REACH_M
    along = np.abs(((points[a] - points[b]) * found.normal).sum(axis=1))
    assert np.median(along) < 1e-3


def test_normals_point_out_of_the_box():
    points, normals = placed(PATCHES, VIEW, POSES, Shared())
    top = points[:, 2] > BOX[1][2] - 0.002
    assert top.sum() > 20 and np.median(normals[top, 2]) > 0.97
    assert (normals * (points - (BOX[0] + BOX[1]) / 2)).sum(axis=1).min() > 0


def test_none_make_no_pair():
    assert match_patches(no_patches(), np.zeros(0, np.int64), POSES, Shared()).pairs.shape == (0, 2)
