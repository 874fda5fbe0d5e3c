"""Chooses the combinations of settings to measure, once each knob has been measured by itself. Pure."""

import itertools
from collections.abc import Iterable, Mapping, Sequence

from services.study.errors import ERRORS
from services.study.knobs import joined
from services.study.model import Row, Setting

SAVES = 0.98
"""A value is cheaper where it takes at most this share of the job's own time."""

WORSE = 1.5
"""An error is kept where it grows by at most this factor."""

BETTER = 0.67
"""An error is better below this share of the job's own."""

NEGLIGIBLE: Mapping[str, float] = {"mm": 0.02, "deg": 0.02, "": 0.001}
"""By unit: errors below this are as good as none, however they compare."""

DEAREST = 5.0
"""A value that takes at least this many times the job's time is measured by itself only."""

MOST_OF_A_KIND = 3
"""The most knobs that are paired among those that save time, and among those that are more exact."""


def promising(rows: Sequence[Row], targets: Mapping[str, float]) -> tuple[Setting, ...]:
    """Settings of two and more knobs to measure next.

    `rows`: the job's own first, then one value of one knob each. For each knob the cheapest value that keeps every error, and
    the most exact value that shrinks one; of either kind the best knobs, two by two and all at once; and at once the cheapest
    value of every knob that meets the targets.
    """
    singles = [row for row in rows[1:] if len(row.setting.parts) == 1 and row.ratio < DEAREST]
    shares = {row.setting.name: _least_share(row, rows[0]) for row in singles}
    cheap = sorted((row for row in singles if row.ratio < SAVES), key=lambda row: (row.ratio, row.setting.name))
    ranks = {name: share for name, share in shares.items() if share is not None and share < BETTER}
    saving = _first_of_knobs(row for row in cheap if shares[row.setting.name] is not None)
    shrinking = [row for row in singles if row.setting.name in ranks]
    exact = _first_of_knobs(sorted(shrinking, key=lambda row: (ranks[row.setting.name], row.setting.name)))
    meeting = _first_of_knobs(
        row for row in cheap if all(row.errors[name].value <= targets[name] for name in set(targets) & set(row.errors))
    )
    pairs = [pair for kind in (saving, exact) for pair in itertools.combinations(kind[:MOST_OF_A_KIND], 2)]
    # In the order of the table, whatever the ranks, so that names do not depend on noise.
    found = [
        joined([row.setting for row in singles if row in some])
        for some in (*pairs, saving, exact, meeting)
        if len(some) > 1
    ]
    return tuple({setting.name: setting for setting in found}.values())


def _first_of_knobs(rows: Iterable[Row]) -> list[Row]:
    """The first value of each knob, in the order of the rows."""
    first: dict[str, Row] = {}
    for row in rows:
        first.setdefault(row.setting.knob, row)
    return list(first.values())


def _least_share(row: Row, own: Row) -> float | None:
    """The least of its errors as a share of the job's own where that is not negligible, 1 without any.

    None where an error has grown beyond the factor and is not negligible.
    """
    both = [name for name in row.errors if name in own.errors]
    pairs = [(row.errors[name].value, own.errors[name].value, NEGLIGIBLE[ERRORS[name].unit]) for name in both]
    if any(value > max(negligible, WORSE * mine) for value, mine, negligible in pairs):
        return None
    return min((value / mine for value, mine, negligible in pairs if mine > negligible), default=1.0)
