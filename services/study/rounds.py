"""A round of the study: settings that are measured side by side, the units of work, and the resulting table."""

import itertools
from dataclasses import dataclass, replace
from typing import Any

from services.study.errors import ERRORS
from services.study.journal import Journal
from services.study.knobs import groups_of
from services.study.measure.statistics import image_figures, settling_figures
from services.study.measure.timing import timed_rows
from services.study.model import Figure, Group, Plan, Row, Setting


@dataclass(frozen=True)
class Unit:
    """One scene to measure with these settings; its answer is kept by its name.

    `kind`: time, settling, images or colour. Of time: its `lap`. Of settling: whether poses are held against the truth
    (`posed`) and objects released again (`released`).
    """

    name: str
    kind: str
    settings: tuple[Setting, ...]
    scene_id: int
    lap: int = 0
    posed: bool = False
    released: bool = False


@dataclass(frozen=True)
class Round:
    """Settings that are measured side by side; the first is the job itself."""

    plan: Plan
    name: str
    settings: tuple[Setting, ...]
    times_only: bool = False

    def of(self, *groups: Group) -> tuple[Setting, ...]:
        """The job's own setting, and those that change any of these parts of a scene."""
        knobs = {knob.name: knob for knob in self.plan.knobs}
        return (self.settings[0], *(one for one in self.settings[1:] if groups_of(one, knobs) & set(groups)))

    def timings(self) -> list[Unit]:
        """The units of time, in the order in which they are taken: lap by lap."""
        first, sizes = self.plan.job.first_scene, self.plan.sizes
        return [
            Unit(f"{self.name}/time/{lap}/{scene}", "time", self.settings, scene, lap)
            for lap, scene in itertools.product(range(sizes.laps), range(first, first + sizes.timed))
        ]

    def errors(self) -> list[Unit]:
        """The units of errors."""
        first, sizes = self.plan.job.first_scene, self.plan.sizes
        kinds: list[tuple[str, tuple[Setting, ...], int]] = [
            ("colour", self.of("colour"), sizes.coloured),
            ("images", self.of("labels", "mirror"), sizes.scenes),
            ("settling", self.of("physics"), sizes.settled),
        ]
        return [
            Unit(
                f"{self.name}/{kind}/{first + number}",
                kind,
                settings,
                first + number,
                posed=number < sizes.posed,
                released=number < sizes.released,
            )
            for kind, settings, count in kinds
            for number in range(count)
            if len(settings) > 1 and not self.times_only
        ]

    def rows(self, journal: Journal) -> tuple[Row, ...]:
        """The round's table, from the answers in the journal; settings without a time are left out."""
        laps: list[dict[int, dict[str, Any]]] = [{} for _ in range(self.plan.sizes.laps)]
        for unit in self.timings():
            laps[unit.lap][unit.scene_id] = journal[unit.name]
        return tuple(self._with_errors(journal, row, scenes) for row, scenes in timed_rows(self.settings, laps))

    def _with_errors(self, journal: Journal, row: Row, scenes: int) -> Row:
        errors = self._errors(journal, row.setting.name)
        return replace(
            row,
            errors=errors,
            failed_share=errors["failed_share"].value if "failed_share" in errors else 0.0,
            notes=() if scenes >= self.plan.sizes.timed else (f"timed in {scenes} scenes",),
        )

    def _errors(self, journal: Journal, name: str) -> dict[str, Figure]:
        """A setting's errors, `failed_share` last and the others in the order of `ERRORS`."""
        answers: dict[str, list[dict[str, Any]]] = {"settling": [], "images": [], "colour": []}
        for unit in self.errors():
            answers[unit.kind].append(journal[unit.name])
        found = settling_figures(name, answers["settling"])
        for kind in ("images", "colour"):
            found |= image_figures([one[name] for one in answers[kind] if name in one])
        order = [error for error in ERRORS if error != "failed_share"]
        return {error: found[error] for error in (*order, "failed_share") if error in found}
