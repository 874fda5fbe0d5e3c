"""One capture from its id to what is written: the list of steps."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from schemas.base import Pose, frozen_array
from schemas.capture import DepthCorrection, ProcessedCapture, Reconstruction
from schemas.errors import CaptureError, ViewError
from schemas.job.assets import Assets
from schemas.job.captures import UNNAMED, Board, Captures
from schemas.job.job import Job
from schemas.scene.scene import EffectPlan, SceneOutput
from schemas.scene.shape import Asset, Material, Part, Shape
from workers.assets.builtin.make import shape_digest
from workers.assets.catalogue import Catalogue, load_asset
from workers.assets.mass import mass_properties
from workers.capture.folder import CaptureFolder, open_folder
from workers.capture.process import CaptureViews
from workers.capture.reconstruct import estimate_surface, given_files
from workers.capture.results import digest_inputs
from workers.capture.rows import (
    CapturedObject,
    CapturedPair,
    LeftOut,
    Origin,
    make_capture_pair,
    record_capture,
    with_targets,
)
from workers.capture.score import read_whole_truth, score_capture
from workers.capture.simulate.simulate import simulate_capture
from workers.capture.truth import read_receipt, read_truth
from workers.door.meshes.mesh import is_solid
from workers.geometry.camera import spread_evenly
from workers.geometry.frames import translation
from workers.scene.chance import SceneChance
from workers.scene.context import WorkerContext
from workers.scene.draw.plan import choose_assets
from workers.stopwatch import Stopwatch
from workers.store.file_system import temporary_folder

BOARD = "board"
"""Category of the board in `objects` and `assets`."""

ROUGHNESS = 0.8
"""Of a reconstructed surface, whose reflection nobody measured."""

NOTE = "reconstructed from a capture: what no view saw, and what lies below the clearance above the board, is missing"


def reconstructed_asset(
    surface: Reconstruction, names: tuple[str, str, str, str], settings: Assets
) -> tuple[Asset, Pose]:
    """The merged mesh in its object frame, and T_board_obj [4, 4]: the origin at the middle of the bounding box.

    The axes are the board's. Mass is that of a thin shell, unless the mesh is closed. `names`: as `_asset` has them.
    """
    centre = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
    opaque = np.full((len(surface.vertex_colors), 1), 255, np.uint8)
    part = Part(
        "surface",
        frozen_array(surface.vertices - centre),
        frozen_array(surface.faces, np.int32),
        Material(base_color=(1.0, 1.0, 1.0, 1.0), roughness=ROUGHNESS),
        colors=frozen_array(np.concatenate([surface.vertex_colors, opaque], axis=1), np.uint8),
    )
    shape = Shape((part,), closed=is_solid(part.vertices, part.faces.astype(np.int64)))
    asset = _asset(names, shape, settings, NOTE)
    return replace(asset, T_source_to_object=frozen_array(translation(*-centre))), frozen_array(translation(*centre))


def board_asset(board: Board, settings: Assets) -> Asset:
    """The board as a rectangle at the print's true size, in the board frame."""
    x, y = 0.5 * board.scale * board.width_m, 0.5 * board.scale * board.height_m
    corners = frozen_array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    shape = Shape((Part("board", corners, frozen_array([[0, 1, 2], [0, 2, 3]], np.int32)),))
    size = f"{board.columns}x{board.rows}-{1e3 * board.scale * board.marker_m:g}mm-from-{board.first_id}"
    if board.markers:
        keys = board.model_dump_json(exclude=board.unwritten)
        size = f"{len(board.markers)}-markers-{hashlib.sha256(keys.encode()).hexdigest()[:8]}"
    names = f"{board.dictionary}-{size}", BOARD, "CC0-1.0", BOARD
    return _asset(names, shape, settings, "its markers are not drawn")


def _asset(names: tuple[str, str, str, str], shape: Shape, settings: Assets, note: str) -> Asset:
    """`names`: instance id, category, licence, and `source` of the shape."""
    instance_id, category, licence, source = names
    density = settings.density_of(category)
    mass = mass_properties(shape, density, settings.shell_kg_m2)
    return Asset(
        instance_id=instance_id,
        category=category,
        source=source,
        licence=licence,
        path=None,
        sha256=shape_digest(shape),
        shape=shape,
        mass=mass,
        T_source_to_object=frozen_array(np.eye(4)),
        scale=1.0,
        watertight=mass.solid,
        volume_m3=mass.mass_kg / density if mass.solid else None,
        shareable=True,
        notes=(note,),
    )


def process_capture(folder: CaptureFolder, captures: Captures, watch: Stopwatch) -> ProcessedCapture:
    """Estimate, merge, score where there is truth. Raises CaptureError where the capture cannot be used."""
    with watch.stage("read"):
        given = given_files(folder, captures.estimation)
    estimates, merged = estimate_surface(given, captures, watch)
    views = CaptureViews(given, captures, estimates.estimate, merged.surface, merged.body)
    with watch.stage("score"):
        truth = read_whole_truth(folder)
        score = None if truth is None else score_capture(views, truth).summary
    return ProcessedCapture(
        name=folder.about.name,
        category=folder.about.category,
        licence=folder.about.licence,
        board=folder.board,
        estimates=estimates,
        surface=merged.surface,
        images=views.images,
        synthesize=views.synthesize,
        undistorted=folder.camera.has_lens,
        depth_corrected=is_corrected(estimates.estimate.depth),
        score=score,
    )


def is_corrected(depth: DepthCorrection) -> bool:
    """Whether an estimate changes what was measured."""
    return depth.offset_m != 0.0 or depth.scale != 1.0 or not np.array_equal(depth.T_cam_depth, np.eye(4))


SOURCE, SIMULATED = "capture", "simulated_capture"
"""`scenes.source` and `assets.source` of captures; those of scenes are the source of the shape."""


def run_capture(context: WorkerContext, scene_id: int, watch: Stopwatch) -> SceneOutput:
    """Simulate or open, estimate, merge, draw the mirror views, score, record. Raises SceneError where it cannot be used."""
    job, captures = context.job, require_captures(context.job)
    with open_capture(context, scene_id, watch) as origin:
        folder = open_folder(origin.path)
        done = process_capture(folder, captures, watch)
        done = replace(done, name=origin.name or done.name)
        category = done.category if "category" in folder.about.model_fields_set else UNNAMED
        with watch.stage("labels"):
            source = SOURCE if read_truth(origin.path) is None else SIMULATED
            thing = place_capture(job, scene_id, done, category, source)
        return record_capture(context, thing, done, origin, make_pairs(context, thing, done, watch), watch)


def place_capture(job: Job, scene_id: int, done: ProcessedCapture, category: str, source: str) -> CapturedObject:
    """The reconstructed object and the board as assets, where they are. Each capture of an object is an instance."""
    names = f"{done.name}-{scene_id:05d}", category, done.licence, source
    asset, T_world_obj = reconstructed_asset(done.surface, names, job.assets)
    board = board_asset(done.board, job.assets)
    return CapturedObject(scene_id, asset, T_world_obj, done.board, board, image_effects(job))


@contextmanager
def open_capture(context: WorkerContext, scene_id: int, watch: Stopwatch) -> Iterator[Origin]:
    """The folder of a capture: one of the job's, or a simulated one that is gone afterwards."""
    captures = require_captures(context.job)
    if captures.folders:
        listing = context.catalogue.captures[scene_id]
        with watch.stage("read"):
            if digest_inputs(listing.folder) != listing.sha256:
                raise CaptureError("changed", f"{listing.folder} does not hold what it held when the run began")
        yield Origin(listing.folder, None, listing.sha256)
        return
    with temporary_folder("capture") as scratch:
        path = scratch / "capture"
        with watch.stage("simulate"):
            instance_id = simulate_one(context, scene_id, path)
            receipt = read_receipt(path)
        yield Origin(path, instance_id, None, *receipt)


def load_object(job: Job, catalogue: Catalogue, chance: SceneChance) -> Asset:
    """The object of a capture, chosen as the first object of a scene is. Raises MeshError where its mesh is refused."""
    (ref, *_), _ = choose_assets(job, catalogue, chance)
    return load_asset(catalogue, ref)


def simulate_one(context: WorkerContext, scene_id: int, path: Path) -> str:
    """Simulates a capture of the job into an empty folder; the instance id of its object."""
    captures, chance = require_captures(context.job), SceneChance(context.job.seed, scene_id)
    asset, around = load_object(context.job, context.catalogue, chance), (context.job.look, context.catalogue)
    simulate_capture(captures.simulate, captures.printed_board, asset, chance, path, around=around)
    return asset.instance_id


def make_pairs(
    context: WorkerContext, thing: CapturedObject, done: ProcessedCapture, watch: Stopwatch
) -> Iterator[CapturedPair | LeftOut]:
    """The pairs of the used views in order, and those views that have none. Raises CaptureError where none has one."""
    used = [view.number for view in done.estimates.estimate.used]
    chosen = [used[place] for place in spread_evenly(len(used), context.job.pairs_per_scene)]
    made = 0
    for at, number in enumerate(chosen):
        try:
            with watch.stage("views"):
                images = done.images(number)
                pair = make_capture_pair(context.job, thing, images, at, done.synthesize, context.renderer.count_pixels)
            item: CapturedPair | LeftOut = with_targets(context.job, thing, pair, watch)
            made += 1
        except (ViewError, CaptureError) as error:
            item = LeftOut(number, "no_pair", error.detail)
        yield item
    for number in sorted(set(used) - set(chosen)):
        yield LeftOut(number, "spare", f"pairs_per_scene is {context.job.pairs_per_scene}")
    if not made:
        raise CaptureError(
            "no_pair", f"none of {len(chosen)} used views sees the object and has a view from the other side"
        )


def image_effects(job: Job) -> EffectPlan:
    """The effects on the images of a dataset that a job of captures has: switches of its keys."""
    projection = job.images.projection
    switches = {
        "mirror": job.cameras.mirror.enabled,
        "projection": projection.enabled,
        "splat": projection.enabled and projection.splat > 1,
        "hidden_point_removal": projection.enabled and projection.hidden_point_removal,
    }
    return EffectPlan((*(name for name, runs in switches.items() if runs), *job.targets.views), {})


def require_captures(job: Job) -> Captures:
    """The branch `captures` of a job that has one."""
    assert job.captures is not None
    return job.captures
