"""Properties of a texture's texels."""

import numpy as np
from numpy.typing import NDArray

HOLE_ALPHA = 128
"""Texels of a smaller alpha, of 255, are holes in colour."""


def has_holes(texture: NDArray[np.uint8] | None) -> bool:
    """Whether a texture [h, w, 3 or 4] has holes."""
    return texture is not None and texture.shape[2] == 4 and bool((texture[..., 3] < HOLE_ALPHA).any())
