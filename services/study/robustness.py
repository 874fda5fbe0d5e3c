"""Pure: whether the choice would be another one if a time were off by its noise."""

import dataclasses
from collections.abc import Sequence

from services.study.choose import Targets, candidates, choose, meets
from services.study.model import Row

NOISE = 0.02
"""How far a ratio may be off: what interleaved medians on one core differ by from run to run."""


def close_calls(
    rows: Sequence[Row], targets: Targets, bounds: Targets | None = None, noise: float = NOISE
) -> list[Row]:
    """The settings whose time decides the choice: were one of them off by `noise`, another setting would be chosen.

    None means that the choice holds. No rule makes it hold where times decide: of made-up studies with 5 to 45 settings
    and ratios off by 1 %, two runs agree on the cheapest setting in 93 of 100, and on what `choose` says in 96. So these
    are the settings to time for some more rounds. Raises what `choose` raises.
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
