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
    as long as there are enough, train has one, then test, then val. The same ids give the same splits.
    """
    found: dict[str, str] = {}
    for names in instances.values():
        order = sorted(names or (), key=lambda name: hashlib.sha256(name.encode()).digest())
        room = len(order) - (shares.train > 0)
        test = max(min(max(round(len(order) * shares.test), shares.test > 0), room), 0)
        val = max(min(max(round(len(order) * shares.val), shares.val > 0), room - test), 0)
        train = len(order) - val - test if shares.train else 0
        kinds = ["train"] * train + ["val"] * (len(order) - train - test) + ["test"] * test
        found |= dict(zip(order, kinds, strict=True))
    return found
