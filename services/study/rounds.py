"""A round of the study: settings that are measured beside one another, what of each, and the table that comes of it."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from services.study.errors import ERRORS
from services.study.journal import Journal
from services.study.knobs import groups_of
from services.study.measure.statistics import image_figures, settling_figures
from services.study.measure.timing import cost_of, job_cost
from services.study.model import Figure, Group, Row, Setting
from services.study.plan import Plan


@dataclass(frozen=True)
class Unit:
    """One thing to measure, which is kept by its name: `kind` is time, settling, images or colour."""

    name: str
    kind: str
    settings: tuple[Setting, ...]
    scene_id: int
    lap: int = 0


@dataclass(frozen=True)
class Round:
    """Settings that are measured beside one another; the job itself is the first of them."""

    plan: Plan
    name: str
    settings: tuple[Setting, ...]
    times_only: bool = False

    def of(self, *groups: Group) -> tuple[Setting, ...]:
        """The settings that change any of these parts of a scene, and the job's own."""
        knobs = {knob.name: knob for knob in self.plan.knobs}
        return tuple(
            setting
            for number, setting in enumerate(self.settings)
            if number == 0 or groups_of(setting, knobs) & set(groups)
        )

    def timings(self) -> list[Unit]:
        """Rounds of timing, one unit a scene."""
        scenes, sizes = self._scenes(self.plan.sizes.timed), self.plan.sizes
        return [
            Unit(f"{self.name}/time/{lap}/{scene}", "time", self.settings, scene, lap)
            for lap, scene in itertools.product(range(sizes.laps), scenes)
        ]

    def errors(self) -> list[Unit]:
        """Everything else, a unit a scene each."""
        sizes = self.plan.sizes
        kinds: list[tuple[str, tuple[Setting, ...], int]] = [
            ("colour", self.of("colour"), sizes.coloured),
            ("images", self.of("labels", "mirror"), sizes.scenes),
            ("settling", self.of("physics"), sizes.settled),
        ]
        return [
            Unit(f"{self.name}/{kind}/{scene}", kind, settings, scene)
            for kind, settings, count in kinds
            for scene in self._scenes(count)
            if len(settings) > 1 and not self.times_only
        ]

    def units(self) -> list[Unit]:
        """All."""
        return [*self.timings(), *self.errors()]

    def _scenes(self, count: int) -> list[int]:
        return list(range(self.plan.job.first_scene, self.plan.job.first_scene + count))

    def rows(self, journal: Journal) -> tuple[Row, ...]:
        """The table of this round from what was measured."""
        return tuple(_rows(self, journal))

    def answers(self, journal: Journal, kind: str) -> list[dict[str, Any]]:
        """Of all scenes, in order."""
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
