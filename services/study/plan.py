"""The plan of a study: the job, its knobs, and how much is measured."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from schemas.job.job import Job
from services.study.model import Knob, Setting


@dataclass(frozen=True)
class Sizes:
    """How much is measured, in scenes.

    `scenes` have their images measured. `settled` only come to rest; the first `released` of them are released again, and
    the first `posed` have their poses compared with the truth. `timed` are timed in each of `laps` rounds; `coloured` are
    drawn with very many paths.
    """

    scenes: int = 48
    settled: int = 500
    released: int = 16
    posed: int = 48
    timed: int = 12
    laps: int = 3
    coloured: int = 4


@dataclass(frozen=True)
class Plan:
    """The job that is timed, its knobs and settings, the presets, the targets, and the sizes."""

    job: Job
    job_folder: Path
    knobs: tuple[Knob, ...]
    settings: tuple[Setting, ...]
    presets: tuple[Setting, ...]
    targets: Mapping[str, float] | None
    sizes: Sizes = field(default_factory=Sizes)
