"""`verso verify --independent N` and `--audit N`: labels derived a second time, and what was skipped proven not to matter.

Exact no-ops: the scene is made again with them forced, and every byte must equal what is stored. Approximations: the
scene at rest is released again with every effect of physics on, and must stay; and it is dropped again from its start. A drop
is chaotic, so that single ends differ; what must agree is how far things go on average.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import t as student_t

from schemas.base import Pose
from schemas.dataset.codec import Row
from schemas.dataset.layout import is_shape, stored_images, stored_roles, stored_shape
from schemas.errors import CorruptError, InputError, SceneError, VersoError, command_line, plural
from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, ObjectStart, Placed, PosedScene, SceneOutput
from schemas.scene.shape import Shape
from schemas.scene.view import MODALITIES, Camera, View
from services.job.record import JobRecord, read_success, require_job
from services.read.dataset_reader import ReadFile, StoredRange, choose_scenes, committed_reader, file_reader, find_scene
from services.read.independent.cameras import read_stands
from services.read.independent.derive import FIRST_OBJECT, Kind, StoredPair
from services.read.independent.poses import check_forces, check_merged, check_pair, list_underived
from services.read.replay import compare_files, compare_rows, is_same_stack, open_context
from services.read.scene_geometry import Sources
from workers.assets.catalogue import Catalogue
from workers.assets.scene_tables import read_scene
from workers.geometry.camera import NEAR_M, project
from workers.geometry.frames import invert, motion_between, transform
from workers.geometry.raycast import edge_distance_px
from workers.physics.hold import release_again
from workers.physics.settle import settle_scene
from workers.render.raster.gbuffer import Renderer
from workers.scene.context import WorkerContext
from workers.scene.effects import EFFECTS, UNFORCED, Facts, names_of_kind, plan_effects
from workers.scene.make_scene import Scene, make_scene
from workers.scene.rows import record_scene
from workers.stopwatch import Stopwatch
from workers.store.commit import committed_files
from workers.store.store import Store

RELEASE_S = 1.0

MOST_MM = 0.05
MOST_DEG = 0.01
"""Largest motion of an object: a few pixels of a mask at most."""

MOST_WAY = 0.05
"""Largest change of the mean way from start to rest, as a share of an object's diagonal, when dropped with every effect."""

EDGE_PX = 1.0 / 128.0
"""Rounding of vertices by the rasteriser: 1/256 px in each of two images."""


@dataclass(frozen=True)
class Motion:
    """Largest motion of an object, changed mask pixels, and those too far from a silhouette to be explained by the motion."""

    moved_mm: float = 0.0
    turned_deg: float = 0.0
    pixels_changed: int = 0
    pixels_outside: int = 0

    def join(self, other: "Motion") -> "Motion":
        """The larger motion and the sum of pixels of two."""
        return Motion(
            max(self.moved_mm, other.moved_mm),
            max(self.turned_deg, other.turned_deg),
            self.pixels_changed + other.pixels_changed,
            self.pixels_outside + other.pixels_outside,
        )

    def describe_excess(self) -> list[str]:
        """Values beyond their bounds, a phrase each."""
        phrases = []
        if not self.moved_mm <= MOST_MM:
            phrases.append(f"it moved {self.moved_mm:.4f} mm, the bound is {MOST_MM} mm")
        if not self.turned_deg <= MOST_DEG:
            phrases.append(f"it turned {self.turned_deg:.5f} degrees, the bound is {MOST_DEG}")
        if self.pixels_outside:
            phrases.append(f"{self.pixels_outside} mask pixels changed away from any silhouette")
        return phrases


def measure_motion(context: WorkerContext, scene: Scene, effects: EffectPlan) -> Motion:
    """Release the scene for `RELEASE_S` with these effects and draw its masks again."""
    poses = release_again(scene.plan, scene.settled, context.job.physics, effects, RELEASE_S)
    largest = Motion()
    for start, rest, pose in zip(scene.plan.objects, scene.settled, poses, strict=True):
        largest = largest.join(move_between(start.asset.shape, rest.T_world_obj, pose))
    at = {start.region_id: pose for start, pose in zip(scene.plan.objects, poses, strict=True)}
    things = (
        dataclasses.replace(thing, T_world_shape=at[thing.region_id]) if thing.region_id in at else thing
        for thing in scene.posed.things
    )
    after = dataclasses.replace(scene.posed, things=tuple(things))
    for view in (view for pair in scene.pairs for view in pair.views if view.region is not None):
        changed, outside = compare_masks(context.renderer, scene.posed, after, view)
        largest = largest.join(Motion(pixels_changed=changed, pixels_outside=outside))
    return largest


def move_between(shape: Shape, before: Pose, after: Pose) -> Motion:
    """Largest motion of a shape's points, and its turn, between two poses [4, 4]."""
    moved_m, turned_rad = motion_between(shape.vertices, before, after)
    return Motion(moved_m * 1e3, math.degrees(turned_rad))


def compare_masks(renderer: Renderer, before: PosedScene, after: PosedScene, view: View) -> tuple[int, int]:
    """(changed mask pixels, those farther from a silhouette than the motion in the image plus `EDGE_PX`)."""
    region = renderer.draw(after.things, after.appearance, view.camera).region
    changed = np.argwhere(region != view.region)
    if not len(changed):
        return 0, 0
    reach = EDGE_PX + max(shift_px(a, b, view.camera) for a, b in zip(before.things, after.things, strict=True))
    away = edge_distance_px(before.things, view.camera, changed, outline_only=True)
    return len(changed), int((away > reach).sum())


def shift_px(before: Placed, after: Placed, camera: Camera) -> float:
    """Largest motion in the image, pixels, of a vertex in front of the camera."""
    if before is after:
        return 0.0
    ends = [transform(invert(camera.T_world_cam) @ one.T_world_shape, one.shape.vertices) for one in (before, after)]
    seen = (ends[0][:, 2] > NEAR_M) & (ends[1][:, 2] > NEAR_M)
    (u0, v0), (u1, v1) = (project(points[seen], camera.intrinsics) for points in ends)
    return float(np.hypot(u1 - u0, v1 - v0).max(initial=0.0))


@dataclass
class Drops:
    """Objects dropped again from their starts with every effect.

    apart_m: how far their ends are from those of before; longer: by which share of their diagonals their ways across the
    ground are longer; lost: how many came to no rest.
    """

    apart_m: list[float] = field(default_factory=list)
    longer: list[float] = field(default_factory=list)
    lost: int = 0

    @property
    def interval(self) -> tuple[float, float]:
        """Where the mean of `longer` lies, 95 %, by Student's t; nan of fewer than two."""
        if len(self.longer) < 2:
            return math.nan, math.nan
        spread = float(np.std(self.longer, ddof=1)) / math.sqrt(len(self.longer))
        half, mean = float(student_t.ppf(0.975, len(self.longer) - 1)) * spread, float(np.mean(self.longer))
        return mean - half, mean + half

    def add(self, starts: Sequence[ObjectStart], before: Sequence[Pose], after: Sequence[Pose]) -> None:
        """Counts objects by where they began and their two ends, [4, 4] each."""
        for start, one, other in zip(starts, before, after, strict=True):
            com = start.asset.mass.com[None, :]
            begun, first, second = (transform(T, com)[0] for T in (start.T_world_obj, one, other))
            ways = [float(np.linalg.norm((end - begun)[:2])) for end in (first, second)]
            self.apart_m.append(move_between(start.asset.shape, one, other).moved_mm / 1e3)
            self.longer.append((ways[1] - ways[0]) / float(np.linalg.norm(start.asset.extents_m)))

    def describe(self) -> str:
        """One line."""
        if not self.apart_m:
            return f"  dropped again with every effect: nothing came to rest, {self.lost} did not"
        near = sum(apart <= MOST_MM / 1e3 for apart in self.apart_m)
        mean, low, high = (100.0 * share for share in (float(np.mean(self.longer)), *self.interval))
        return (
            f"  dropped again from the start with every effect: {near} of {plural(len(self.apart_m), 'object')} end in the same "
            f"place, the farthest {max(self.apart_m) * 1e3:.1f} mm away; ways differ by {mean:+.2f} % of the diagonal on average "
            f"[{low:+.2f}, {high:+.2f}]; {self.lost} came to no rest"
        )


def drop_again(context: WorkerContext, scene: Scene, effects: EffectPlan, drops: Drops) -> None:
    """Drops the objects of a scene from their starts with these effects, and counts where they end."""
    try:
        rest = settle_scene(scene.plan, context.job.physics, effects)
    except SceneError:
        drops.lost += len(scene.plan.objects)
        return
    before, after = ([each.T_world_obj for each in one] for one in (scene.settled, rest.settled))
    drops.add(scene.plan.objects, before, after)


@dataclass
class IndependentVerdict:
    """Counts of what was derived, what has no second derivation for this job, and the faults, a sentence each."""

    scenes: int = 0
    pairs: int = 0
    underived: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def stored_kinds(job: Job) -> dict[str, list[Kind]]:
    """The rows of the modalities that a job stores, by role, as the independent code takes them."""
    kinds = {}
    for role in (*stored_roles(job), *(entry.name for entry in job.cameras.more)):
        images = ((image.content, MODALITIES[image.pixels]) for image in stored_images(role, job))
        kinds[str(role)] = [
            Kind(m.name, word, m.dtype, (*stored_shape(m, 1, 1, job), 1)[2], m.each, m.formula) for word, m in images
        ]
    return kinds


def _open_tables(record: JobRecord) -> Catalogue | None:
    """The catalogue of a job that names tables, where they are what they were when it was run."""
    if record.job.scenes_from is not None or any(entry.poses for entry in record.job.cameras.more):
        with contextlib.suppress(VersoError, OSError):
            return Sources(record).catalogue
    return None


def verify_independently(
    store: Store, count: int, progress: Callable[[IndependentVerdict], None]
) -> IndependentVerdict:
    """Derive the labels of `count` scenes a second time. Raises OutputError where the folder is no dataset."""
    record = require_job(store)
    job = record.job.model_dump(mode="json")
    catalogue = _open_tables(record)
    tables = {name: file.path for name, file in catalogue.poses.items()} if catalogue else {}
    verdict, kinds = IndependentVerdict(underived=list_underived(job, tables)), stored_kinds(record.job)
    if record.job.scenes_from is not None and catalogue is None:
        verdict.underived.append("poses are not compared with scenes_from: it is not here, or not what it was")
    views: list[Row] = []
    objects: list[Row] = []
    absent: dict[int, str] = {}
    for scene_id in choose_scenes(store, count, record.job.seed):
        stored = find_scene(store, scene_id)
        scene = stored.scene(scene_id)
        images = file_reader(committed_reader(store, stored.records), stored.records)
        assert scene is not None
        stands, given = {name: read_stands(path, scene_id) for name, path in tables.items()}, None
        fallen = set[int]()
        if catalogue and catalogue.scenes is not None:
            rows = read_scene(catalogue.scenes, scene_id)
            falls = job["scene"] != "studio"
            kept = [None if each.of_source or (each.settle and falls) else each.T_world_obj for each in rows.objects]
            given = (
                [(each.instance_id, T) for each, T in zip(rows.objects, kept, strict=True)],
                [T for T, _ in rows.cameras],
            )
            fallen = {FIRST_OBJECT + number for number, each in enumerate(rows.objects) if each.settle}
        verdict.faults += check_forces(job, scene, fallen)

        def read(path: str, images: ReadFile = images) -> bytes:
            return store.read(path) if is_shape(path) else images(path)

        for pair_views, pair_objects in stored.pairs(scene_id):
            pair = StoredPair(job, scene, pair_views, pair_objects, read, kinds, given=given, stands=stands)
            try:
                verdict.faults += check_pair(pair)
            except CorruptError as error:
                verdict.faults.append(str(error))
            if pair.absent:
                absent.setdefault(scene_id, pair.absent[0])
            views += pair_views.values()
            objects += pair_objects
            verdict.pairs += 1
        verdict.scenes += 1
        progress(verdict)
    if absent:
        path = next(iter(absent.values()))
        what = f"what the shapes show is not derived in {plural(len(absent), 'scene')}"
        verdict.underived.append(f"{what}: {path} is not stored; a source with copy_assets: true has its shapes stored")
    if read_success(store) is not None:
        verdict.faults += check_merged(store.read, views, objects)
    return verdict


def describe_independent(verdict: IndependentVerdict) -> Iterator[str]:
    """Every fault, what was derived and what was not, line by line."""
    yield from verdict.faults
    labels = f"labels of {plural(verdict.pairs, 'pair')} of {plural(verdict.scenes, 'scene')}"
    off = len(verdict.faults) or "nothing"
    yield f"{labels} derived from the article's definitions, and their rest from contact forces: {off} off"
    yield from (f"  {line}" for line in verdict.underived)


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
    drops: Drops = field(default_factory=Drops)
    effects: dict[str, Tally] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)


def audit(store: Store, count: int, progress: Callable[[Audit], None]) -> Audit:
    """Audit `count` scenes. Raises OutputError where the folder is no dataset, InputError where it is one of captures."""
    record = require_job(store)
    if record.job.captures is not None:
        raise InputError(
            "--audit forces effects that the plan of a scene left out, and a capture has no such plan: "
            f"`{command_line('replay', store.name)} CAPTURE` makes one again and compares every byte"
        )
    context = open_context(record)
    tallies = {effect.name: Tally(effect.kind) for effect in EFFECTS if effect.kind != "asked"}
    audited = Audit(is_same_stack(store, context), effects=tallies)
    for scene_id in choose_scenes(store, count, record.job.seed):
        _audit_scene(context, store, scene_id, audited)
        progress(audited)
    low, high = audited.drops.interval
    if low > MOST_WAY or high < -MOST_WAY:
        audited.faults.append(f"what was left out changes how far objects go: {audited.drops.describe().strip()}")
    return audited


def _audit_scene(context: WorkerContext, store: Store, scene_id: int, audited: Audit) -> None:
    stored = find_scene(store, scene_id)
    row = stored.scene(scene_id)
    assert row is not None
    forcible = {one["effect"] for one in row["skipped"] if not one["why"].startswith(UNFORCED)}
    left_out = sorted(forcible & audited.effects.keys())
    for name in left_out:
        audited.effects[name].skipped += 1
    audited.scenes += 1
    no_ops, approximations = (
        [name for name in left_out if audited.effects[name].kind == kind] for kind in ("no_op", "approximation")
    )
    try:
        scene, output = make_forced(context, scene_id, no_ops)
    except SceneError as error:
        audited.faults.append(f"scene {scene_id} with {', '.join(no_ops) or 'nothing'} forced cannot be made: {error}")
        return
    audited.forced += len(no_ops)
    audited.files += len(output.files)
    audited.bytes += sum(len(file.data) for file in output.files)
    plain = None if audited.same_stack else make_forced(context, scene_id)[1]
    proven = _prove_no_ops(context, lambda now: _differences(store, stored, plain, now), output, no_ops, audited)
    if approximations:
        facts = Facts(context.job, scene.plan, scene.raycast_checked)
        effects = plan_effects(facts, names_of_kind("approximation"))
        motion = measure_motion(context, scene, effects)
        drop_again(context, scene, effects, audited.drops)
        audited.released += 1
        audited.motion = audited.motion.join(motion)
        released = f"scene {scene_id}, {', '.join(approximations)}: released with every effect"
        excess = motion.describe_excess()
        audited.faults += [f"{released}, {one}" for one in excess]
        proven += [] if excess else approximations
    for name in proven:
        audited.effects[name].proven += 1


def _prove_no_ops(
    context: WorkerContext,
    differences: Callable[[SceneOutput], list[str]],
    output: SceneOutput,
    no_ops: list[str],
    audited: Audit,
) -> list[str]:
    """The no-ops that change nothing; where the scene with all of them forced differs, each is forced by itself."""
    if not differences(output):
        return no_ops
    if again := differences(make_forced(context, output.scene_id)[1]):
        audited.faults.append(f"scene {output.scene_id}: made again with nothing forced, it differs: {again[0]}")
        return []
    changed = {name: differences(make_forced(context, output.scene_id, [name])[1]) for name in no_ops}
    audited.faults += [
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


def describe_audit(audited: Audit) -> Iterator[str]:
    """Every fault, the figures, and what was proven of each effect, line by line."""
    yield from audited.faults
    against = (
        "what is stored" if audited.same_stack else "a plain scene made here, because another stack made what is stored"
    )
    yield (
        f"audit of {plural(audited.scenes, 'scene')}: {plural(audited.forced, 'no-op')} forced, {plural(audited.files, 'file')} "
        f"({audited.bytes / 1e6:.1f} MB) compared to the byte with {against}"
    )
    motion = audited.motion
    yield (
        f"  {audited.released} released for 1 s with every effect: moved at most {motion.moved_mm:.4f} mm, turned at most "
        f"{motion.turned_deg:.5f} degrees; {motion.pixels_changed} mask pixels changed, {motion.pixels_outside} of them "
        "away from any silhouette"
    )
    yield audited.drops.describe()
    for name, tally in audited.effects.items():
        if tally.skipped:
            yield f"  {name} ({tally.kind}): left out in {plural(tally.skipped, 'scene')}, proven in {tally.proven}"
    yield f"  {len(audited.faults) or 'nothing'} off"
