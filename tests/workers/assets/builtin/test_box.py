"""Boxes: with a seam, a slot or a lid that shows."""

import numpy as np
import pytest

from tests.workers.assets.oracles import welded
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
