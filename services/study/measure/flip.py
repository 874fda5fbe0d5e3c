"""FLIP (Andersson et al. 2020) by flip-evaluator: the visible difference on flipping between two images, 0 to 1.

The observer is the authors' default: 0.7 m before a screen 0.7 m and 3840 pixels wide, 67 of the image's pixels in a degree.
The package calls `sys.exit` on wrong arguments and misreads integers, so it only gets float32 in [0, 1]. Its map is the same
on one thread (`OMP_NUM_THREADS`) and on several; its mean, summed in float32, is not, so it is not used.
"""

import numpy as np
from numpy.typing import NDArray


def flip_between(reference: NDArray[np.uint8], rgb: NDArray[np.uint8]) -> float:
    """The mean of FLIP's map, from 0 for equal images to 1. Both are [H, W, 3] uint8 sRGB of one size. Raises ValueError."""
    import flip_evaluator  # of the extra `study`

    for image in (reference, rgb):
        if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"FLIP compares [H, W, 3] uint8 of one size, not {image.shape} {image.dtype}")
    a, b = (np.ascontiguousarray(image, np.float32) / np.float32(255) for image in (reference, rgb))
    seen, _, _ = flip_evaluator.evaluate(a, b, "LDR", applyMagma=False, computeMeanError=False)
    return float(np.asarray(seen, np.float64).mean())
