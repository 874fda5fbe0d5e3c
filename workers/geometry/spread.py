"""Some of many things in a row, evenly over their order."""

import numpy as np
from numpy.typing import NDArray


def spread_evenly(count: int, most: int) -> NDArray[np.int64]:
    """[min(count, most)] ascending: places of at most so many of `count` things; of two or more, the first and the last."""
    if count <= most:
        return np.arange(count, dtype=np.int64)
    return np.linspace(0, count - 1, most).round().astype(np.int64)
