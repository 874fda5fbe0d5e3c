"""Chooses the combinations of settings to measure, once each knob has been measured by itself. Pure."""

import itertools
from collections.abc import Callable, Mapping, Sequence

from services.study.knobs import joined
from services.study.model import Row, Setting

SAVES = 0.98
"""A value is cheaper where it takes at most this share of the job's own time."""

WORSE = 1.5
"""An error is kept where it grows by at most this factor."""

BETTER = 0.67
"""An error is better below this share of the job's own."""

NEGLIGIBLE: Mapping[str, float] = {
    "mm": 0.02,
    "deg": 0.02,
    "": 0.001,
}
"""By unit: errors below this are as good as none, however they compare."""

DEAREST = 5.0
"""A value that takes at least this many times the job's time is measured by itself only."""

MOST_OF_A_KIND = 3
"""The most knobs that are paired among those that save time, and among those that are more exact."""


def promising(rows: Sequence[Row], units: Mapping[str, str], targets: Mapping[str, float]) -> tuple[Setting, ...]:
    """Settings of two and more knobs to measure next.

    `rows`: the job's own first, then one value of one knob each. `units` of errors by name. For each knob the cheapest value
    that keeps every error, and the most exact value that shrinks one; of either kind the best knobs, two by two and all at
    once; and at once the cheapest value of every knob that meets the targets.
    """
    own, singles = rows[0], [row for row in rows[1:] if len(row.setting.parts) == 1 and row.ratio < DEAREST]

    def least_share(row: Row) -> float:
        return _least_share(row, own, units)

    cheap = [row for row in singles if row.ratio < SAVES]
    saving = _best_of_knobs([row for row in cheap if _keeps(row, own, units)], _ratio)
    exact = _best_of_knobs([row for row in singles if least_share(row) < BETTER], least_share)
    meeting = _best_of_knobs([row for row in cheap if _meets(row, targets)], _ratio)
    pairs = [pair for kind in (saving, exact) for pair in itertools.combinations(kind[:MOST_OF_A_KIND], 2)]
    # In the order of the table, whatever the ranks, so that names do not depend on noise.
    found = [
        joined([row.setting for row in singles if row in some])
        for some in (*pairs, saving, exact, meeting)
        if len(some) > 1
    ]
    return tuple({setting.name: setting for setting in found}.values())


def _ratio(row: Row) -> float:
    return row.ratio


def _best_of_knobs(rows: Sequence[Row], rank: Callable[[Row], float]) -> list[Row]:
    """The first value of each knob, in the order of rank and then name."""
    best: dict[str, Row] = {}
    for row in sorted(rows, key=lambda row: (rank(row), row.setting.name)):
        best.setdefault(row.setting.parts[0][0], row)
    return list(best.values())


def _keeps(row: Row, own: Row, units: Mapping[str, str]) -> bool:
    """Whether every error stays within the factor, or negligible."""
    return all(
        figure.value <= max(NEGLIGIBLE[units[name]], WORSE * own.errors[name].value)
        for name, figure in row.errors.items()
        if name in own.errors
    )


def _least_share(row: Row, own: Row, units: Mapping[str, str]) -> float:
    """The least of its errors as a share of the job's own where that is not negligible; 1 where another error has grown."""
    shares = [
        figure.value / own.errors[name].value
        for name, figure in row.errors.items()
        if name in own.errors and own.errors[name].value > NEGLIGIBLE[units[name]]
    ]
    return min(shares, default=1.0) if _keeps(row, own, units) else 1.0


def _meets(row: Row, targets: Mapping[str, float]) -> bool:
    return all(row.errors[name].value <= bound for name, bound in targets.items() if name in row.errors)
