"""Pure: whether a preset is worth its time, by what was measured."""

from collections.abc import Sequence

from schemas.job.preset import PRESETS
from services.study.choose import error_of, own_row
from services.study.errors import ERRORS
from services.study.model import Row
from services.study.pairs import NEGLIGIBLE

SLACK = 0.1
"""A preset may take a tenth more time than a setting that is as good, and have errors a tenth larger than one as cheap."""

MORE_EFFORT = (
    "physics.max_step_travel_mm",
    "physics.solver_iterations",
    "physics.rest.speed_mm_s",
    "physics.rest.spin_rad_s",
    "physics.collision",
    "physics.correction",
    "render.path_samples",
)

BY_EFFORT = frozenset((*PRESETS["balanced"], *MORE_EFFORT))
"""What presets choose or could: settings that change anything else store something else, and are no rivals."""


def preset_row(rows: Sequence[Row], name: str) -> Row:
    """The row of a preset; that of the job where no preset's row has the name, as the job has one of them itself."""
    return next((row for row in rows if row.setting.parts == (("preset", name),)), own_row(rows))


def rivals(rows: Sequence[Row]) -> list[Row]:
    """Settings that change what presets choose, and nothing else."""
    return [row for row in rows if set(row.setting.changes) <= BY_EFFORT]


def better_than(preset: Row, rows: Sequence[Row], slack: float = SLACK) -> list[str]:
    """Names of rivals that put a preset off the front.

    One that is no worse in any error, and cheaper by more than the slack; or one that is no dearer and no worse in any
    error, and better in one by more than the slack, beyond the noise of either.
    """
    found = []
    for rival in rivals(rows):
        if rival.setting == preset.setting or not _no_worse(rival, preset, rows):
            continue
        cheaper = rival.ratio * (1.0 + slack) < preset.ratio
        if cheaper or (rival.ratio <= preset.ratio and _better(rival, preset, rows, slack)):
            found.append(rival.setting.name)
    return found


def _no_worse(rival: Row, preset: Row, rows: Sequence[Row]) -> bool:
    for name, kind in ERRORS.items():
        theirs, ours = error_of(rival, name, rows), error_of(preset, name, rows)
        if theirs and ours and theirs.value > max(ours.value, NEGLIGIBLE[kind.unit]):
            return False
    return True


def _better(rival: Row, preset: Row, rows: Sequence[Row], slack: float) -> bool:
    for name, kind in ERRORS.items():
        theirs, ours = error_of(rival, name, rows), error_of(preset, name, rows)
        if theirs and ours and ours.value > NEGLIGIBLE[kind.unit] and theirs.high * (1.0 + slack) < ours.low:
            return True
    return False
