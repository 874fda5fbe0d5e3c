"""One scene through production's physics alone, judged, and let go again: figures in mm, degrees, shares and seconds."""

import dataclasses
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from unittest import mock

from schemas.errors import SceneError
from schemas.job.physics import Physics
from schemas.scene.scene import EffectPlan, ObjectStart, ScenePlan, Settled
from schemas.scene.shape import Mesh
from tests.judge.judge import Thing, Verdict, judge
from tests.judge.referee import hold_scene
from workers.geometry.frames import transform
from workers.physics import settle
from workers.physics.effects import called_for
from workers.physics.fall import FINEST
from workers.physics.pour import NOTHING_MORE, Pouring
from workers.physics.settle import recheck_scene, settle_scene

PARTS = ("release", "hold")
"""The parts of `workers.physics.settle` whose time is taken: what moves the objects, and what brings them to rest."""

CRASHED = "crashed"
"""The reason of a scene that ended with an error that is no SceneError: always a defect."""


@dataclass(frozen=True)
class Asked:
    """What is done with a scene beside settling and judging it."""

    recheck: bool = False
    mujoco: bool = False


@dataclass(frozen=True)
class Outcome:
    """One scene: the reason why it was refused, or the worst of its objects in each figure; times of one processor."""

    scene_id: int
    objects: int
    seconds: float
    parts_s: dict[str, float]
    refused: str = ""
    detail: str = ""
    verdicts: list[Verdict] = field(default_factory=list)
    stored: Verdict | None = None
    """The same figures as production measured them."""
    judge_s: float = 0.0
    moved_mm: float | None = None
    turned_deg: float | None = None
    mujoco_mm: float | None = None
    mujoco_deg: float | None = None
    redrawn: int = 0
    """Starts that were drawn again because an object had left the table."""

    @property
    def worst(self) -> Verdict:
        """The worst of its objects in each figure."""
        return worst_of(self.verdicts)


def worst_of(verdicts: Sequence[Verdict]) -> Verdict:
    """The greatest of each figure."""
    return Verdict(
        max(each.overlap_mm for each in verdicts),
        max(each.hover_mm for each in verdicts),
        max(each.unbalanced for each in verdicts),
    )


def try_scene(
    scene_id: int, plan: ScenePlan, physics: Physics, asked: Asked, pouring: Pouring = NOTHING_MORE
) -> Outcome:
    """Settle a scene and judge it. What it raises is told in the outcome."""
    effects = EffectPlan(tuple(sorted(called_for(plan.objects, plan.table, physics))), {})
    began = time.process_time()
    with _timed() as parts_s:
        try:
            rest = settle_scene(plan, physics, effects, pouring)
        except SceneError as error:
            refused, detail = error.reason, error.detail
        except Exception:
            refused, detail = CRASHED, traceback.format_exc()
        else:
            refused = detail = ""
    seconds = time.process_time() - began
    if refused:
        return Outcome(scene_id, len(plan.objects), seconds, parts_s, refused, detail)
    drawn, plan = plan, dataclasses.replace(plan, objects=rest.starts)
    began = time.process_time()
    verdicts = judge(things_at_rest(plan.objects, rest.settled), plan.table.mesh, frictions_of(plan.objects, physics))
    judge_s = time.process_time() - began
    moved: tuple[float | None, float | None] = (None, None)
    if asked.recheck:
        again = recheck_scene(plan, rest, physics, effects, FINEST).settled
        moved = max(one.recheck_move_mm or 0.0 for one in again), max(one.recheck_turn_deg or 0.0 for one in again)
    poses = [one.T_world_obj for one in rest.settled]
    held = (hold_scene(plan, poses, physics) if asked.mujoco else None) or (None, None)
    return Outcome(
        scene_id,
        len(plan.objects),
        seconds,
        parts_s,
        verdicts=list(verdicts),
        stored=worst_of(
            [Verdict(one.penetration_mm, one.hover_gap_mm, one.equilibrium_residual) for one in rest.settled]
        ),
        judge_s=judge_s,
        moved_mm=moved[0],
        turned_deg=moved[1],
        mujoco_mm=held[0],
        mujoco_deg=held[1],
        redrawn=sum(one.redraws for one in plan.objects) - sum(one.redraws for one in drawn.objects),
    )


def things_at_rest(starts: Sequence[ObjectStart], settled: Sequence[Settled]) -> list[Thing]:
    """The objects as the judge reads them."""
    things = []
    for start, rest in zip(starts, settled, strict=True):
        T, shape, mass = rest.T_world_obj, start.asset.shape, start.asset.mass
        mesh = Mesh(transform(T, shape.vertices), shape.faces)
        things.append(Thing(mesh, mass.mass_kg, transform(T, mass.com[None, :])[0]))
    return things


def frictions_of(starts: Sequence[ObjectStart], physics: Physics) -> list[float]:
    """Of the objects, and last of the table."""
    return [physics.friction_of(name) for name in (*(start.asset.category for start in starts), "table")]


@contextmanager
def _timed() -> Iterator[dict[str, float]]:
    """Processor seconds of each of `PARTS`, summed over its calls."""
    spent: dict[str, float] = {}

    def timed(name, part):
        def run(*given, **named):
            began = time.process_time()
            try:
                return part(*given, **named)
            finally:
                spent[name] = spent.get(name, 0.0) + time.process_time() - began

        return run

    with mock.patch.multiple(settle, **{name: timed(name, getattr(settle, name)) for name in PARTS}):
        yield spent
