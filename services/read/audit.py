"""`verso verify --audit N`: proves on N scenes that the effects which their plans left out did not matter.

Exact no-ops: the scene is made again with them forced, and every byte must equal what is stored.
Approximations: the scene at rest is released again with every effect of physics on (audit_motion.py). Where MuJoCo is installed,
it holds every scene as a referee (referee.py): its figures are told, and have no bound.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from schemas.dataset.layout import FINGERPRINT_FILE, is_shape
from schemas.dataset.shard import Fingerprint
from schemas.errors import InputError, SceneError
from schemas.scene.scene import SceneOutput
from services.job.record import require_job
from services.read.audit_motion import Motion, measure_motion
from services.read.dataset_reader import StoredRange, choose_scenes, find_scene
from services.read.referee import Held, describe_held, hold_scene, is_installed
from services.read.replay import compare_files, compare_rows, open_context
from workers.scene.context import Stopwatch, WorkerContext
from workers.scene.effects import EFFECTS
from workers.scene.make_scene import Scene, make_scene
from workers.scene.rows import record_scene
from workers.shard.fingerprint import take_fingerprint
from workers.store.commit import committed_files
from workers.store.store import Store

RECEIPT = frozenset({"effects", "skipped"})
"""Columns that name the effects that ran: forcing changes them."""


@dataclass
class Tally:
    """One effect: the audited scenes that left it out, and those where that was proven not to matter."""

    kind: str
    skipped: int = 0
    proven: int = 0


@dataclass
class Audit:
    """Counts of what was made again, the largest motion, and the faults, a sentence each."""

    same_stack: bool
    scenes: int = 0
    forced: int = 0
    """No-ops forced, over all scenes."""
    files: int = 0
    bytes: int = 0
    released: int = 0
    """Scenes released again."""
    motion: Motion = field(default_factory=Motion)
    """Largest motion of any scene, and changed pixels of all."""
    held: Held | None = None
    """What MuJoCo found; None where it is not installed."""
    effects: dict[str, Tally] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)


def audit(store: Store, count: int, progress: Callable[[Audit], None]) -> Audit:
    """Audit `count` scenes. Raises OutputError where the folder is no dataset, InputError where it is one of captures."""
    record = require_job(store)
    if record.job.captures is not None:
        raise InputError(
            "--audit forces effects that the plan of a scene left out, and a capture has no such plan: "
            f"`verso replay {store.name} CAPTURE` makes one again and compares every byte"
        )
    context = open_context(record)
    theirs = Fingerprint.model_validate_json(store.read(FINGERPRINT_FILE))
    tallies = {effect.name: Tally(effect.kind) for effect in EFFECTS if effect.kind != "asked"}
    found = Audit(take_fingerprint(context.renderer, context.job.render.tier) == theirs, effects=tallies)
    found.held = Held() if is_installed() else None
    for scene_id in choose_scenes(store, count, record.job.seed):
        _audit_scene(context, store, scene_id, found)
        progress(found)
    return found


def _audit_scene(context: WorkerContext, store: Store, scene_id: int, found: Audit) -> None:
    stored = find_scene(store, scene_id)
    row = stored.scene(scene_id)
    assert row is not None
    left_out = sorted({one["effect"] for one in row["skipped"]} & found.effects.keys())
    for name in left_out:
        found.effects[name].skipped += 1
    found.scenes += 1
    no_ops, approximations = (
        [name for name in left_out if found.effects[name].kind == kind] for kind in ("no_op", "approximation")
    )
    try:
        scene, output = make_forced(context, scene_id, no_ops)
    except SceneError as error:
        found.faults.append(f"scene {scene_id} with {', '.join(no_ops) or 'nothing'} forced cannot be made: {error}")
        return
    found.forced += len(no_ops)
    found.files += len(output.files)
    found.bytes += sum(len(file.data) for file in output.files)
    plain = None if found.same_stack else make_forced(context, scene_id)[1]
    proven = _prove_no_ops(context, lambda now: _differences(store, stored, plain, now), output, no_ops, found)
    if found.held is not None:
        held = hold_scene(scene.plan, scene.settled, context.job.physics)
        found.held = found.held.join(held or Held())
    if approximations:
        motion = measure_motion(context, scene)
        found.released += 1
        found.motion = found.motion.join(motion)
        released = f"scene {scene_id}, {', '.join(approximations)}: released with every effect"
        excess = motion.describe_excess()
        found.faults += [f"{released}, {one}" for one in excess]
        proven += [] if excess else approximations
    for name in proven:
        found.effects[name].proven += 1


def _prove_no_ops(
    context: WorkerContext,
    differences: Callable[[SceneOutput], list[str]],
    output: SceneOutput,
    no_ops: list[str],
    found: Audit,
) -> list[str]:
    """The no-ops that change nothing; where the scene with all of them forced differs, each is forced by itself."""
    if not differences(output):
        return no_ops
    if again := differences(make_forced(context, output.scene_id)[1]):
        found.faults.append(f"scene {output.scene_id}: made again with nothing forced, it differs: {again[0]}")
        return []
    changed = {name: differences(make_forced(context, output.scene_id, [name])[1]) for name in no_ops}
    found.faults += [
        f"scene {output.scene_id}, {name}: forced, it changes {len(files)} files or tables: {files[0]}"
        for name, files in changed.items()
        if files
    ]
    return [name for name in no_ops if not changed[name]]


def make_forced(context: WorkerContext, scene_id: int, forced: Iterable[str] = ()) -> tuple[Scene, SceneOutput]:
    """A scene made again with effects forced, and its output. Raises SceneError."""
    stopwatch, context = Stopwatch(), dataclasses.replace(context, forced=frozenset(forced))
    scene = make_scene(context, scene_id, stopwatch)
    return scene, record_scene(context, scene, stopwatch)


def _differences(store: Store, stored: StoredRange, plain: SceneOutput | None, output: SceneOutput) -> list[str]:
    """Differences from what is stored, or from the plain scene made here where another stack made what is stored."""
    if plain is not None:
        before, now = ({file.path: file.sha256 for file in one.files} for one in (plain, output))
        return [f"{path}: is not the same" for path in sorted({*before, *now}) if before.get(path) != now.get(path)]
    committed = {entry.path: entry.sha256 for record in stored.records for entry in committed_files(store, record)}
    shapes = [file for file in output.files if is_shape(file.path) and file.path in committed]
    return [
        *compare_files(store, stored, output, True),
        *(f"{file.path}: is not the same" for file in shapes if file.sha256 != committed[file.path]),
        *compare_rows(stored, output, RECEIPT),
    ]


def describe_audit(found: Audit) -> Iterator[str]:
    """Every fault, the figures, and what was proven of each effect, line by line."""
    yield from found.faults
    against = (
        "what is stored" if found.same_stack else "a plain scene made here, because another stack made what is stored"
    )
    yield (
        f"audit of {found.scenes} scenes: {found.forced} no-ops forced, {found.files} files "
        f"({found.bytes / 1e6:.1f} MB) compared to the byte with {against}"
    )
    motion = found.motion
    yield (
        f"  {found.released} released for 1 s with every effect: moved at most {motion.moved_mm:.4f} mm, turned at most "
        f"{motion.turned_deg:.5f} degrees; {motion.pixels_changed} mask pixels changed, {motion.pixels_outside} of them "
        "away from any silhouette"
    )
    yield describe_held(found.held)
    for name, tally in found.effects.items():
        if tally.skipped:
            yield f"  {name} ({tally.kind}): left out in {tally.skipped} scenes, proven in {tally.proven}"
    yield f"  {len(found.faults) or 'nothing'} off"
