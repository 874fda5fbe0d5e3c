"""A round of the study: settings that are measured side by side, the units of work, and the resulting table."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from services.study.errors import ERRORS
from services.study.journal import Journal
from services.study.knobs import groups_of
from services.study.measure.statistics import image_figures, settling_figures
from services.study.measure.timing import cost_of, job_cost
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
        """The round's table, from the answers in the journal."""
        return tuple(_rows(self, journal))

    def answers(self, journal: Journal, kind: str) -> list[dict[str, Any]]:
        """The answers of one kind, scene by scene."""
        return [journal[unit.name] for unit in self.errors() if unit.kind == kind]


def _rows(part: Round, journal: Journal) -> Iterator[Row]:
    own = part.settings[0].name
    laps: list[dict[int, dict[str, Any]]] = [{} for _ in range(part.plan.sizes.laps)]
    for unit in part.timings():
        laps[unit.lap][unit.scene_id] = journal[unit.name]
    own_ms, own_kb = job_cost(laps, own)
    for setting in part.settings:
        cost = cost_of(setting.name, own, laps)
        if cost is None:
            continue
        errors = _errors(part, journal, setting)
        failed = errors.pop("failed_share", None)
        yield Row(
            setting=setting,
            ms=own_ms * cost.ratio.median,
            ratio=cost.ratio.median,
            ratio_least=cost.ratio.least,
            ratio_most=cost.ratio.most,
            kilobytes=own_kb if cost.kilobytes is None else cost.kilobytes,
            errors=errors if failed is None else {**errors, "failed_share": failed},
            failed_share=0.0 if failed is None else failed.value,
            notes=() if cost.scenes >= part.plan.sizes.timed else (f"timed in {cost.scenes} scenes",),
        )


def _errors(part: Round, journal: Journal, setting: Setting) -> dict[str, Figure]:
    """In the order of `ERRORS`."""
    found = settling_figures(setting.name, part.answers(journal, "settling"))
    for kind in ("images", "colour"):
        found.update(image_figures([one[setting.name] for one in part.answers(journal, kind) if setting.name in one]))
    return {name: found[name] for name in ERRORS if name in found}
