"""Splits of instances whose shares hold within each category. Pure."""

import hashlib
from collections.abc import Collection, Mapping

from schemas.job.assets import SplitShares

Split = str
"""train, val or test."""


def split_by_category(
    instances: Mapping[str, Collection[str]], shares: SplitShares, held_out: Collection[str] = ()
) -> dict[str, Split]:
    """The split of every instance; `instances`: ids by category. Those of the categories in `held_out` are all in test.

    A category's instances stand in the order of their ids' hashes, as in `assets.split`, and are cut where the shares say;
    as long as there are enough, each split that has a share has one. The same ids give the same splits.
    """
    found: dict[str, Split] = {}
    for category, names in instances.items():
        order = sorted(names, key=lambda name: hashlib.sha256(name.encode()).digest())
        val, test = _counts(len(order), shares) if category not in held_out else (0, len(order))
        kinds = ["train"] * (len(order) - val - test) + ["val"] * val + ["test"] * test
        found |= dict(zip(order, kinds, strict=True))
    return found


def _counts(count: int, shares: SplitShares) -> tuple[int, int]:
    """How many of a category's instances are in val and in test: train goes first, then test, then val."""
    room = count - (shares.train > 0)
    test = min(max(round(count * shares.test), int(shares.test > 0)), max(room, 0))
    val = min(max(round(count * shares.val), int(shares.val > 0)), max(room - test, 0))
    return (val, test) if shares.train > 0 else (count - test, test)
