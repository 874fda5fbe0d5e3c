"""What hollow things have in common: a ray down the middle finds the inside of the bottom."""

import numpy as np

from tests.workers.assets.oracles import hits
from workers.assets.builtin.make import make_model


def bottom_heights(category: str, index: int) -> tuple[float, float]:
    """Heights, true metres, at which a ray down through the mouth meets the inner and the outer side of the bottom."""
    solid = make_model(category, 0, index).solid
    top = float(solid.vertices[:, 2].max())
    distances, sides = hits(solid.vertices, solid.faces, np.array([1e-4, 2e-4, top + 1.0]), np.array([0.0, 0.0, -1.0]))
    assert sides.tolist() == [-1.0, 1.0]
    return top + 1.0 - float(distances[0]), top + 1.0 - float(distances[1])
