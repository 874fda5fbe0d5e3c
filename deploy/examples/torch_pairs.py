"""Pairs of a dataset as a PyTorch Dataset: one split, read on demand."""

from typing import Any

import torch
from mirror_depth import make_example
from splits import Split, pairs_of_split
from torch.utils.data import Dataset

from services.dataset.dataset import open_dataset


class MirrorDepthPairs(Dataset):
    """Pairs of one split by instance; an item is a dict of tensors [..., H, W] as `mirror_depth.Example` tells them.

    The ids are looked up once; images are read and decoded when an item is asked for, so that worker processes of a
    DataLoader share nothing.
    """

    def __init__(self, place: str, split: Split) -> None:
        self._pairs = open_dataset(place)
        self.ids = [pair.pose_id for pair in pairs_of_split(self._pairs, split)]

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> dict[str, Any]:
        example = make_example(self._pairs.pair(self.ids[index]))
        if example is None:  # too near the rim: the next one stands in
            return self[(index + 1) % len(self)]
        known = (example.depth > 0)[None]
        return {
            "features": torch.from_numpy(example.features),
            "background": torch.from_numpy(example.background)[None],
            "depth": torch.from_numpy(example.depth)[None],
            "mask": torch.from_numpy(example.mask)[None],
            "known": torch.from_numpy(known),
            "middle_m": torch.tensor(example.middle_m).reshape(1, 1, 1),
        }
