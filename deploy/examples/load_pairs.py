"""Measures how fast pairs are read, beside OpenCV that decodes the same files by hand.

PYTHONPATH=. .venv/bin/python deploy/examples/load_pairs.py data/training [--kinds rgb,depth,region,normals,albedo]

Prints medians of processor time for one pair's mirror view, `pair(id)` included, both sides in turn in one run; and, where
PyTorch is installed, pairs a second of a DataLoader with two workers beside OpenCV in this process. Files are read from memory.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from services.dataset.dataset import open_dataset

PAIRS, REPEATS = 60, 8
STEP = np.float32(2.0 / 65_535.0)
READERS = {"region": "segment"}
"""Methods of a view that are not named after the kind of image."""


class Pairs:
    """Images of the mirror view by number; what a DataLoader takes as a Dataset."""

    def __init__(self, place: str, kinds: list[str]) -> None:
        self.dataset, self.kinds = open_dataset(place), kinds
        first = [pair for pair, _ in zip(self.dataset.pairs(), range(PAIRS), strict=False) if pair.mirror]
        self.ids = [pair.pose_id for pair in first]
        self.paths = [[Path(place) / pair.mirror.images[kind] for kind in kinds] for pair in first if pair.mirror]

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, number: int) -> list[NDArray]:
        view = self.dataset.pair(self.ids[number]).mirror
        return [getattr(view, READERS.get(kind, kind))() for kind in self.kinds]

    def by_hand(self, number: int) -> list[NDArray]:
        """The same of the files `paths[number]`, decoded by OpenCV: RGB in its order, normals from -1 to 1."""
        images = [
            cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
            for path in self.paths[number]
        ]
        ordered = [cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if image.ndim == 3 else image for image in images]
        return [
            image.astype(np.float32) * STEP - np.float32(1.0) if kind == "normals" else image
            for kind, image in zip(self.kinds, ordered, strict=True)
        ]


def core_ms(read: Callable[[int], Any], number: int) -> float:
    """Processor time of one call."""
    begun = time.process_time()
    read(number)
    return 1e3 * (time.process_time() - begun)


def feed(pairs: Pairs) -> float:
    """Pairs a second of a DataLoader with two workers, which are started before."""
    from torch.utils.data import DataLoader

    loader = DataLoader(pairs, batch_size=4, num_workers=2, persistent_workers=True)  # type: ignore[arg-type, var-annotated]
    for _ in loader:
        pass
    begun = time.perf_counter()
    for _ in range(REPEATS):
        for _ in loader:
            pass
    return REPEATS * len(pairs) / (time.perf_counter() - begun)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("place", metavar="DATASET", help="a folder whose pairs have these images")
    parser.add_argument("--kinds", default="rgb,depth,region,normals,albedo")
    options = parser.parse_args()
    pairs = Pairs(options.place, options.kinds.split(","))
    cv2.setNumThreads(1)
    times = [(core_ms(pairs.__getitem__, n), core_ms(pairs.by_hand, n)) for n in range(len(pairs)) for _ in range(3)]
    ours, hand = (statistics.median(column) for column in zip(*times, strict=True))
    print(f"a pair: {ours:.2f} ms of processor, OpenCV by hand {hand:.2f} ms, ratio {ours / hand:.2f}")
    if find_spec("torch") is not None:
        begun = time.perf_counter()
        for number in [*range(len(pairs))] * REPEATS:
            pairs.by_hand(number)
        alone = REPEATS * len(pairs) / (time.perf_counter() - begun)
        fed = feed(pairs)
        print(
            f"DataLoader, 2 workers: {fed:.0f} pairs/s, OpenCV by hand in one process {alone:.0f}, ratio {fed / alone:.2f}"
        )


if __name__ == "__main__":
    main()
