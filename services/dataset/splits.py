"""Splits of instances whose shares hold within each category, in memory that does not grow with the dataset. Pure."""

import hashlib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from schemas.dataset.codec import Row
from schemas.job.assets import SplitShares

MOST_INSTANCES = 10_000
"""Instances of a category that are put in order; of more, the column of `assets` has the shares within 1 %."""


@dataclass(frozen=True)
class Splits:
    """The splits of a dataset's instances."""

    by_id: Mapping[str, str]
    """train, val or test; of instances that are not here, the column of `assets` holds."""
    held_out: frozenset[str] = frozenset()
    """Categories that are all in test."""

    def of(self, asset: Row) -> str:
        """The split of a row of `assets`."""
        if asset["category"] in self.held_out:
            return "test"
        return self.by_id.get(asset["instance_id"], asset["split"])


def collect_ids(batches: Iterable[Iterable[Row]]) -> dict[str, set[str] | None]:
    """The instance ids of each category in rows of `assets`; None where there are more than `MOST_INSTANCES`."""
    found: dict[str, set[str] | None] = {}
    for row in (row for rows in batches for row in rows):
        ids = found.setdefault(row["category"], set())
        if ids is not None:
            ids.add(row["instance_id"])
            if len(ids) > MOST_INSTANCES:
                found[row["category"]] = None
    return found


def split_by_category(instances: Mapping[str, Collection[str] | None], shares: SplitShares) -> dict[str, str]:
    """The split of every instance; `instances`: ids by category, as `collect_ids` has them.

    A category's instances stand in the order of their ids' hashes, as in `assets.split`, and are cut where the shares say;
    as long as there are enough, each split that has a share has one. The same ids give the same splits.
    """
    found: dict[str, str] = {}
    for names in instances.values():
        order = sorted(names or (), key=lambda name: hashlib.sha256(name.encode()).digest())
        val, test = _counts(len(order), shares)
        kinds = ["train"] * (len(order) - val - test) + ["val"] * val + ["test"] * test
        found |= dict(zip(order, kinds, strict=True))
    return found


def _counts(count: int, shares: SplitShares) -> tuple[int, int]:
    """How many of a category's instances are in val and in test: train goes first, then test, then val."""
    room = count - (shares.train > 0)
    test = min(max(round(count * shares.test), int(shares.test > 0)), max(room, 0))
    val = min(max(round(count * shares.val), int(shares.val > 0)), max(room - test, 0))
    return (val, test) if shares.train > 0 else (count - test, test)
