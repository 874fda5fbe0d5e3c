"""Boxes: with a seam, a slot or a lid that shows; a lid is wider than its box, and a ribbon is joined to it."""

import numpy as np
import pytest
import trimesh

from tests.workers.assets.oracles import welded
from workers.assets.builtin.box import EXTRA, LID, SIDE, make_lidded
from workers.assets.builtin.make import make_model
from workers.assets.builtin.parts import cut_into_parts


@pytest.mark.parametrize("index", range(25))
def test_a_box_fills_most_of_its_bounding_box_but_has_a_seam_in_it(index):
    model = make_model("box", 0, index)
    whole = welded(cut_into_parts(model.solid, model.surfaces, np.zeros(3), 1.0))
    filled = whole.volume / whole.bounding_box.volume
    assert 0.55 < filled < 0.9999
    # The seam is a fold: some points lie deeper than the convex hull by at least half a millimetre.
    hull = whole.convex_hull
    outward, offset = hull.face_normals, -np.einsum("ij,ij->i", hull.face_normals, hull.triangles[:, 0])
    depth = -(whole.vertices @ outward.T + offset).max(axis=1)
    assert depth.max() > 0.0005


@pytest.mark.parametrize("seed", range(25))
def test_the_lid_overhangs_the_box_and_a_ribbon_goes_all_around(seed):
    solid = make_lidded(np.random.default_rng(seed)).solid
    corners = solid.vertices[solid.faces]
    lid, side = (corners[solid.surface == s].reshape(-1, 3) for s in (LID, SIDE))
    assert np.ptp(lid[:, 0]) > np.ptp(side[:, 0]) + 0.002
    assert lid[:, 2].min() > 0.4 * side[:, 2].max()
    ribbon = corners[solid.surface == EXTRA].reshape(-1, 3)
    if len(ribbon):
        assert np.ptp(ribbon[:, 0]) > np.ptp(lid[:, 0])
        assert ribbon[:, 2].min() == 0.0
        assert ribbon[:, 2].max() > lid[:, 2].max()
    mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    assert mesh.is_volume
    assert mesh.body_count == 1
