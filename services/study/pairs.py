"""Pure: which settings are worth measuring together, once each has been measured by itself."""

import itertools
from collections.abc import Mapping, Sequence

from services.study.knobs import joined
from services.study.model import Figure, Row, Setting

SAVES = 0.98
"""Of the job's own time: a value that takes at most this much is cheaper."""

WORSE = 1.5
"""An error that grows by less than this factor is kept."""

BETTER = 0.67
"""An error that shrinks below this share of the job's own is better."""

NEGLIGIBLE: Mapping[str, float] = {
    "mm": 0.02,
    "deg": 0.02,
    "": 0.001,
}
"""By unit: errors below this are as good as none, however they compare."""

DEAREST = 5.0
"""A value that takes so many times the job's time is an end of its own, and is not measured with others."""

MOST_OF_A_KIND = 3
"""So many knobs are paired among those that save time, and among those that are more exact."""


def promising(rows: Sequence[Row], units: Mapping[str, str], targets: Mapping[str, float]) -> tuple[Setting, ...]:
    """Settings of two and more knobs to measure next.

    `rows`: the job's own first, then one value of one knob each. `units` of errors by name. Of each knob the cheapest value
    that keeps every error, and the most exact one that shrinks one; of either kind the knobs that do most, two by two and
    all at once; and of every knob the cheapest value that meets the targets, at once.
    """
    own, singles = rows[0], [row for row in rows[1:] if len(row.setting.parts) == 1 and row.ratio < DEAREST]
    saving = _best_of_knobs([row for row in singles if row.ratio < SAVES and _keeps(row, own, units)], _by_time)
    exact = _best_of_knobs(
        [row for row in singles if _shrinks(row, own, units) < BETTER], lambda r: _shrinks(r, own, units)
    )
    groups = [saving, exact]
    found: dict[str, Setting] = {}
    for kind in groups:
        chosen = kind[:MOST_OF_A_KIND]
        for some in (*itertools.combinations(chosen, 2), tuple(kind)):
            if len(some) > 1:
                setting = joined(_in_order([row.setting for row in some], singles))
                found[setting.name] = setting
    meeting = _best_of_knobs([row for row in singles if row.ratio < SAVES and _meets(row, targets)], _by_time)
    if len(meeting) > 1:
        setting = joined(_in_order([row.setting for row in meeting], singles))
        found[setting.name] = setting
    return tuple(found.values())


def _by_time(row: Row) -> float:
    return row.ratio


def _best_of_knobs(rows: Sequence[Row], rank) -> list[Row]:  # type: ignore[no-untyped-def]
    """The first of each knob by rank, in the order of rank and then name."""
    best: dict[str, Row] = {}
    for row in sorted(rows, key=lambda row: (rank(row), row.setting.name)):
        best.setdefault(row.setting.parts[0][0], row)
    return list(best.values())


def _in_order(settings: Sequence[Setting], singles: Sequence[Row]) -> list[Setting]:
    """As the knobs stand in the table, whatever their rank was, so that a name does not hang on noise."""
    place = {row.setting.name: number for number, row in enumerate(singles)}
    return sorted(settings, key=lambda setting: place[setting.name])


def _keeps(row: Row, own: Row, units: Mapping[str, str]) -> bool:
    """Whether no error has grown beyond noise: by the factor, and beyond what is negligible."""
    return all(
        figure.value <= NEGLIGIBLE[units[name]] or figure.value <= WORSE * own.errors[name].value
        for name, figure in row.errors.items()
        if name in own.errors
    )


def _shrinks(row: Row, own: Row, units: Mapping[str, str]) -> float:
    """The least of its errors as a share of the job's own, of those that are not negligible; 1 where another has grown."""
    if not _keeps(row, own, units):
        return 1.0
    return min((_share(figure, own.errors[name]) for name, figure in _compared(row, own, units)), default=1.0)


def _compared(row: Row, own: Row, units: Mapping[str, str]) -> list[tuple[str, Figure]]:
    return [
        (name, figure)
        for name, figure in row.errors.items()
        if name in own.errors and own.errors[name].value > NEGLIGIBLE[units[name]]
    ]


def _share(figure: Figure, own: Figure) -> float:
    return figure.value / own.value


def _meets(row: Row, targets: Mapping[str, float]) -> bool:
    return all(row.errors[name].value <= bound for name, bound in targets.items() if name in row.errors)
