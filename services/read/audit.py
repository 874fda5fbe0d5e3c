"""`verso verify --audit N`: that what a scene's plan of effects left out did not matter, proven on N scenes.

Exact no-ops: the scene is made again with all that were left out forced, and every byte must be what is stored.
Approximations: what is stored is released again with nothing left out (audit_motion.py).
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from schemas.dataset.fingerprint import Fingerprint
from schemas.dataset.layout import ASSETS, FINGERPRINT_FILE
from schemas.errors import SceneError
from schemas.scene.scene import SceneOutput
from services.job.record import require_job
from services.read.audit_motion import Motion, measure_motion
from services.read.dataset_reader import StoredRange, find_scene, iter_stored
from services.read.replay import compare_files, compare_rows, open_context
from workers.pipeline.context import WorkerContext
from workers.pipeline.fingerprint import take_fingerprint
from workers.pipeline.make_scene import Scene, make_scene
from workers.pipeline.rows import record_scene
from workers.pipeline.stopwatch import Stopwatch
from workers.plan.effects import EFFECTS, names_of_kind
from workers.store.store import Store

RECEIPT = frozenset({"effects", "skipped"})
"""Columns that say what was forced, and so differ."""


@dataclass
class Tally:
    """Of one effect: how many of the audited scenes left it out, and in how many that was proven not to matter."""

    kind: str
    skipped: int = 0
    proven: int = 0


@dataclass
class Audit:
    """What was made again, what came of it, and what is off, a sentence each."""

    same_stack: bool
    scenes: int = 0
    forced: int = 0
    """No-ops forced, over all scenes."""
    files: int = 0
    bytes: int = 0
    released: int = 0
    """Scenes released again."""
    motion: Motion = field(default_factory=Motion)
    """The worst of all scenes, and its pixels over all of them."""
    effects: dict[str, Tally] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)


def audit(store: Store, count: int, progress: Callable[[Audit], None]) -> Audit:
    """Audit so many of the dataset's scenes. Raises OutputError where the folder is no dataset."""
    record = require_job(store)
    context = open_context(record)
    theirs = Fingerprint.model_validate_json(store.read(FINGERPRINT_FILE))
    found = Audit(take_fingerprint(context.renderer, context.job.render.tier) == theirs)
    for effect in EFFECTS:
        if effect.kind != "asked":
            found.effects[effect.name] = Tally(effect.kind)
    made = [row["scene_id"] for stored in iter_stored(store) for row in stored.rows["scenes"]]
    for scene_id in choose_evenly(made, count, record.job.seed):
        _audit_scene(context, store, scene_id, found)
        progress(found)
    return found


def choose_evenly(scenes: Sequence[int], count: int, seed: int) -> list[int]:
    """`count` of the scenes, or all, evenly over their ids; the seed says from where on."""
    ordered = sorted(scenes)
    if count >= len(ordered):
        return ordered
    first = float(np.random.default_rng(seed).random())
    return [ordered[int((i + first) * len(ordered) / count)] for i in range(count)]


def _audit_scene(context: WorkerContext, store: Store, scene_id: int, found: Audit) -> None:
    stored = find_scene(store, scene_id)
    row = next(row for row in stored.rows["scenes"] if row["scene_id"] == scene_id)
    left_out = {one["effect"] for one in row["skipped"]}
    for name in left_out & set(found.effects):
        found.effects[name].skipped += 1
    found.scenes += 1
    no_ops = frozenset(left_out & names_of_kind("no_op"))
    approximations = left_out & names_of_kind("approximation")
    made = _force_no_ops(context, (store, stored), scene_id, no_ops, found)
    if made is None:
        return
    if approximations:
        _release(context, made, sorted(approximations), found)


def _force_no_ops(
    context: WorkerContext, where: tuple[Store, StoredRange], scene_id: int, no_ops: frozenset[str], found: Audit
) -> Scene | None:
    """The scene made with these forced; None, and the fault, where that cannot be."""
    try:
        scene, output = make_forced(context, scene_id, no_ops)
    except SceneError as error:
        found.faults.append(f"scene {scene_id} with {_listed(no_ops)} forced cannot be made: {error}")
        return None
    found.forced += len(no_ops)
    found.files += len(output.files)
    found.bytes += sum(len(file.data) for file in output.files)
    plain = None if found.same_stack else make_forced(context, scene_id, frozenset())[1]
    differences = _differences(where, plain, output)
    if not differences:
        for name in no_ops:
            found.effects[name].proven += 1
        return scene
    again = _differences(where, plain, make_forced(context, scene_id, frozenset())[1])
    if again:
        found.faults.append(f"scene {scene_id}: made again with nothing forced, it differs: {again[0]}")
        return scene
    for name in sorted(no_ops):
        alone = _differences(where, plain, make_forced(context, scene_id, frozenset({name}))[1])
        if alone:
            found.faults.append(
                f"scene {scene_id}, {name}: forced, it changes {len(alone)} files or tables: {alone[0]}"
            )
        else:
            found.effects[name].proven += 1
    return scene


def make_forced(context: WorkerContext, scene_id: int, forced: frozenset[str]) -> tuple[Scene, SceneOutput]:
    """A scene made again with effects forced, and what is written of it. Raises SceneError."""
    watch, context = Stopwatch(), dataclasses.replace(context, forced=forced)
    scene = make_scene(context, scene_id, watch)
    return scene, record_scene(context, scene, watch)


def _differences(where: tuple[Store, StoredRange], plain: SceneOutput | None, output: SceneOutput) -> list[str]:
    """Against what is stored, or against the scene made here without anything forced where another stack stored it."""
    if plain is not None:
        before, now = ({file.path: file.sha256 for file in one.files} for one in (plain, output))
        return [f"{path}: is not the same" for path in sorted({*before, *now}) if before.get(path) != now.get(path)]
    store, stored = where
    committed = {entry.path: entry.sha256 for record in stored.records for entry in record.files}
    assets = [file for file in output.files if file.path.startswith(f"{ASSETS}/") and file.path in committed]
    return [
        *compare_files(store, stored, output, True),
        *(f"{file.path}: is not the same" for file in assets if file.sha256 != committed[file.path]),
        *compare_rows(stored, output, RECEIPT),
    ]


def _release(context: WorkerContext, scene: Scene, names: Sequence[str], found: Audit) -> None:
    """Release what came to rest with nothing left out, and see what moves."""
    motion = measure_motion(context, scene)
    found.released += 1
    found.motion = found.motion.worse(motion)
    off = motion.off()
    found.faults += [f"scene {scene.plan.scene_id}, {_listed(names)}: released with every effect, {one}" for one in off]
    if not off:
        for name in names:
            found.effects[name].proven += 1


def _listed(names: Sequence[str] | frozenset[str]) -> str:
    return ", ".join(sorted(names)) or "nothing"
