"""Edge: the convex parts of shapes of libraries, found by the pool before the first scene asks for them."""

import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.environment import cache_folder
from schemas.errors import MachineError, MeshError
from schemas.job.assets import Assets, LibrarySource
from schemas.job.job import Job
from services.run.progress import show_counts
from workers.assets.catalogue import Catalogue
from workers.pool import Answers, Ended, run_pool

if TYPE_CHECKING:
    from workers.assets.library.table import Library, Row

MOST_TOLD = 3
"""Meshes that are named one by one."""

MOST_CUT = 2000
"""Shapes of a job that are cut ahead; of a larger collection, each is cut where a scene first drops it."""

USUAL_FOLDER = cache_folder("parts")


@dataclass(frozen=True)
class Cut:
    """A shape to be cut, and the key of the answer. Its library has no rows, which may be many."""

    library: "Library"
    row: "Row"
    settings: LibrarySource
    assets: Assets
    instance_id: str
    concavity: float

    @property
    def key(self) -> str:
        """Digest of what the parts follow from."""
        from workers.physics.convex_parts import key_of, version_of_parts  # unused by built-in shapes

        asked = json.dumps([self.instance_id, self.row.key, self.concavity])
        return key_of("parts", version_of_parts(), asked)


def find_parts(job: Job, catalogue: Catalogue, folder: Path | None = USUAL_FOLDER) -> None:
    """Cuts every shape that the job may drop onto another object, and keeps its parts in `folder`, where workers look for them.

    Single objects are left out: over a flat table few ever need parts. Raises MachineError where a process is killed.
    """
    if job.captures is not None or job.physics.collision in ("box", "hull") or folder is None:
        return
    if job.objects_per_scene.high == 1 and job.physics.collision != "parts":
        return
    cuts = list(_shapes(job, catalogue))
    if not cuts or len(cuts) > MOST_CUT:
        return
    deep = sorted(f"{cut.row.path}: {message}" for cut, _, message in cut_shapes(cuts, folder) if message)
    if deep:
        more = f"; and {len(deep) - MOST_TOLD} more" if len(deep) > MOST_TOLD else ""
        print(f"verso: {'; '.join(deep[:MOST_TOLD])}{more}", file=sys.stderr)


def _shapes(job: Job, catalogue: Catalogue) -> Iterator[Cut]:
    """Every shape of a library that the job may draw as an object."""
    for number, (settings, library) in enumerate(zip(catalogue.assets.objects, catalogue.objects, strict=True)):
        if library is None:
            continue
        assert isinstance(settings, LibrarySource)
        alone = replace(library, rows=())
        for category in job.categories:
            for index, row in enumerate(library.entries.get(category, ())):
                if row.use:
                    name = catalogue.refer(number, category, index).instance_id
                    yield Cut(alone, row, settings, catalogue.assets, name, job.physics.concavity)


def cut_shapes(cuts: Iterable[Cut], folder: Path | None = USUAL_FOLDER) -> Iterator[tuple[Cut, int, str]]:
    """Each shape with its number of parts, 0 where it is refused, and what is to be told of it, empty for nothing.

    A shape is cut once for ever. Raises MachineError where a process is killed.
    """
    asked, kept = list(cuts), Answers(folder and folder / "cut")
    with show_counts("meshes", "shape") as watch:
        for done, (cut, answer) in enumerate(run_pool(cut_shape, asked, key=lambda cut: cut.key, kept=kept), 1):
            watch("cut into convex parts", done, len(asked))
            if not isinstance(answer, Ended):
                yield cut, *json.loads(answer)
            elif answer.how == "killed":
                raise MachineError(
                    f"a process that cuts {cut.row.path} into convex parts was killed: start again, what is cut stays"
                )
            else:
                yield cut, 0, f"cannot be cut: it {answer.detail}; set `use` of its row in library.parquet to false"


def cut_shape(cut: Cut) -> bytes:
    """In a process of the pool: finds the parts of a shape; as JSON, how many, and what is to be told of them."""
    from workers.assets.library.shapes import load_shape
    from workers.geometry.hull import hull_of
    from workers.geometry.mesh import fills_hull
    from workers.physics.convex_parts import decompose

    try:
        asset = load_shape(cut.library, cut.row, cut.settings, cut.assets, cut.instance_id)
    except MeshError:
        return json.dumps([0, ""]).encode()  # refused, or changed meanwhile: its scenes say so
    if asset.volume_m3 is not None and fills_hull(asset.volume_m3, hull_of(asset.shape).vertices):
        return json.dumps([1, ""]).encode()
    parts, size_m = decompose(asset.shape.mesh, asset.sha256, cut.concavity), max(asset.extents_m)
    deep = parts.depth_m > cut.concavity * size_m  # twice what is asked for
    count = len(parts.clouds)
    message = (
        f"{count} convex parts fill hollows of {parts.depth_m * 1e3:.1f} mm, deeper than physics.concavity = "
        f"{cut.concavity:g} asks for; it rests on its true mesh all the same"
    )
    return json.dumps([count, message if deep else ""]).encode()
