"""The lower bound of time for the same files: bare draws, the fastest encoder, and a durable write."""

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from schemas.dataset.commit import CommitRecord
from services.bench.encoders import Encoder, kind_of
from services.bench.ratios import Lap
from workers.pipeline.make_scene import Scene
from workers.render.raster.gbuffer import FLAT, Renderer
from workers.store.file_system import sync_path, sync_tree
from workers.store.images import Pixels, decode_png


def committed_files(root: Path, record: CommitRecord) -> dict[str, bytes]:
    """The bytes of every file that a commit names."""
    return {entry.path: (root / entry.path).read_bytes() for entry in record.files}


def images_of(files: Mapping[str, bytes]) -> list[tuple[Pixels, int]]:
    """Pixels and size of every PNG among the files."""
    return [(decode_png(data, path), len(data)) for path, data in files.items() if path.endswith(".png")]


def run_lower_bound(
    renderer: Renderer,
    scenes: Sequence[Scene],
    files: Mapping[str, bytes],
    chosen: Mapping[str, tuple[str, Encoder]],
    folder: Path,
) -> Lap:
    """Draw every view, encode every image, and write every byte so that it survives a loss of power. `folder` is new.

    The lap's `apart_s` is a first draw of each scene, which uploads its shapes.
    """
    upload, draw, draw_cpu = _draw(renderer, scenes)
    images = images_of(files)
    begun, cpu = time.perf_counter(), time.process_time()
    for pixels, _ in images:
        chosen[kind_of(pixels)][1](pixels)
    encoded = time.perf_counter()
    write_durably(files, folder)
    written = time.perf_counter()
    stages = {"draw": draw, "encode": encoded - begun, "write": written - encoded}
    return Lap(len(scenes), sum(stages.values()), draw_cpu + time.process_time() - cpu, stages, upload)


def _draw(renderer: Renderer, scenes: Sequence[Scene]) -> tuple[float, float, float]:
    """Seconds of uploading every scene's shapes, then of the clock and of the processor for bare passes.

    A bare pass draws and reads back colour without shadows, depth and region, as tier flat does, whatever the job's tier.
    """
    upload, wall, cpu = 0.0, 0.0, 0.0
    for scene in scenes:
        views = [view.camera for pair in scene.pairs for view in pair.views if view.role != "projected"]
        things, appearance = scene.posed.things, scene.posed.appearance
        begun = time.perf_counter()
        renderer.draw(things, appearance, views[0], FLAT)
        drawn, drawn_cpu = time.perf_counter(), time.process_time()
        for camera in views:
            renderer.draw(things, appearance, camera, FLAT)
        upload, wall = upload + drawn - begun, wall + time.perf_counter() - drawn
        cpu += time.process_time() - drawn_cpu
    return upload, wall, cpu


def write_durably(files: Mapping[str, bytes], folder: Path) -> int:
    """Write the files beside `folder`, flush them, and rename them into place at once. Returns the bytes written."""
    staging = folder.with_name(f".{folder.name}")
    written = 0
    for path, data in files.items():
        target = staging / path
        try:
            file = open(target, "wb")  # noqa: SIM115 - closed below
        except FileNotFoundError:
            target.parent.mkdir(parents=True)
            file = open(target, "wb")  # noqa: SIM115
        with file:
            written += file.write(data)
    sync_tree(staging)
    os.rename(staging, folder)
    sync_path(folder.parent)
    return written
