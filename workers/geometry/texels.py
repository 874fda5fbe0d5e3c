"""Properties of a texture's texels."""

import numpy as np
from numpy.typing import NDArray


def has_holes(texture: NDArray[np.uint8] | None) -> bool:
    """Whether a texture [h, w, 3 or 4] has texels whose alpha is below one half."""
    return texture is not None and texture.shape[2] == 4 and bool((texture[..., 3] < 128).any())
