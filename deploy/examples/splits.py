"""Pairs of one split, so that no object of the training pairs is in a test pair."""

from collections.abc import Iterator, Mapping
from typing import Literal

import pyarrow as pa
import pyarrow.compute as pc

from services.dataset.dataset import Dataset
from services.dataset.pair import Pair

Split = Literal["train", "val", "test"]


def pairs_of_split(dataset: Dataset, split: Split, splits: Mapping[str, str] | None = None) -> Iterator[Pair]:
    """Every pair whose objects are all of instances of this split.

    `splits`: by instance; by default the column of `assets`, which follows from the instance's id and is the same in every
    dataset. `dataset.splits()` has the shares in each category. A scene of several objects of different splits is in none.
    """
    if splits is None:
        rows = dataset.table("assets").to_table(columns=["instance_id", "split"]).to_pylist()
        splits = {row["instance_id"]: row["split"] for row in rows}
    for pair in dataset.pairs(
        pc.field("instance_id").isin(pa.array([name for name in splits if splits[name] == split], pa.string()))
    ):
        if all(splits[name] == split for name in instances_of(pair)):
            yield pair


def instances_of(pair: Pair) -> set[str]:
    """The ids of all objects of a pair's scene."""
    return {pair.instance_id, *(body["instance_id"] for body in pair.scene["bodies"] or ())}
