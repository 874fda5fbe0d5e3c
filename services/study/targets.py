"""The targets that a user types, and those that a job cannot have. Pure."""

import math
from collections.abc import Callable
from typing import NamedTuple

from schemas.errors import InputError, did_you_mean
from schemas.job.job import Job
from services.study.choose import Targets
from services.study.model import ERRORS, unit

KEPT = "kept_share"
"""How a user may ask for a share of objects that are kept: `lost_share` is 1 minus it."""


def parse_targets(text: str) -> dict[str, float]:
    """From "penetration_mm=0.1,depth_mm=0.5". Raises InputError with the remedy."""
    targets: dict[str, float] = {}
    for part in text.split(","):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or not name:
            raise InputError(f"--target {part.strip() or text!r}: write it as penetration_mm=0.1,depth_mm=0.5")
        try:
            most = float(value)
        except ValueError:
            most = math.nan
        if name == KEPT:
            name, most = "lost_share", round(1.0 - most, 12)
            value = f"{most:g}"
        if name not in ERRORS:
            known = ", ".join(ERRORS)
            raise InputError(f"--target {name}: there is no such error; {did_you_mean(name, ERRORS)}Known: {known}")
        if name in targets:
            raise InputError(f"--target {name}: is given twice, as {targets[name]:g} and as {value}")
        if not 0.0 <= most < math.inf:
            example = ", a share such as 0.001 for 0.1 %" if unit(name) == "%" else ""
            raise InputError(f"--target {name}={value}: must be a number from 0 up{example}")
        targets[name] = most
    return targets


class Unmeasured(NamedTuple):
    """Jobs in which an error, or the errors of some groups, cannot be measured, and why."""

    is_so: Callable[[Job], bool]
    names: str
    why: str


_UNMEASURED = (
    Unmeasured(lambda job: job.captures is None, "capture", "the job has no captures"),
    Unmeasured(lambda job: job.captures is not None, "physics labels mirror colour", "the job is one of captures"),
    Unmeasured(lambda job: not job.cameras.mirror.enabled, "mirror", "cameras.mirror.enabled is false"),
    Unmeasured(lambda job: not job.render.rgb, "colour", "render.rgb is false"),
    Unmeasured(
        lambda job: job.start.pose == "tumbled" or job.objects_per_scene.high > 1,
        "pose_mm",
        "where things end is random when they tumble or meet, so no pose is the true one; ask for outcome_mm",
    ),
)


def refuse_unmeasured(job: Job, targets: Targets, missing: str | None) -> None:
    """Raises InputError for a target that no setting of the job can have, before anything is measured.

    `missing` says why this machine has no truth of colour.
    """
    for name in targets:
        for row in _UNMEASURED:
            if row.is_so(job) and {name, ERRORS[name].group} & set(row.names.split()):
                raise InputError(f"--target {name}: it cannot be measured here: {row.why}")
        if name == "flip" and missing is not None:
            raise InputError(f"--target flip: {missing}")
