"""OUT/DATASET.md: the contents of a dataset, the stack that made it, and the sources of its shapes."""

from typing import TYPE_CHECKING

from schemas.base import Counts
from schemas.dataset.layout import ARTICLE, FINGERPRINT_FILE, JOB_FILE, README_FILE, stored_roles
from schemas.dataset.shard import Fingerprint
from schemas.job.assets import ProceduralSource
from schemas.job.captures import Captures
from services.job.record import JobRecord
from services.merge.merge import MergeResult
from workers.store.commit import is_sealed, seal
from workers.store.store import Store

if TYPE_CHECKING:
    from workers.assets.catalogue import Catalogue

SHAPES_OF_CAPTURES = (
    "- reconstructed from the captures: the merged mesh with the licence in capture.json; what no view saw is missing\n"
    "- boards: a rectangle, CC0-1.0"
)

SEAL = ("<!-- SHA-256 of the text above: ", " -->\n")
"""The ends of the card's last line."""


def is_card_sealed(data: bytes) -> bool:
    """Whether the bytes of a card are those that a run wrote."""
    return is_sealed(data, *SEAL)


def write_card(store: Store, record: JobRecord, catalogue: "Catalogue", merged: MergeResult) -> None:
    """Writes DATASET.md."""
    fingerprint = Fingerprint.model_validate_json(store.read(FINGERPRINT_FILE))
    store.put(README_FILE, seal(describe_dataset(record, catalogue, merged, fingerprint), *SEAL))


def describe_dataset(record: JobRecord, catalogue: "Catalogue", merged: MergeResult, fingerprint: Fingerprint) -> str:
    """The text of DATASET.md."""
    job = record.job
    libraries = "\n".join(f"| {name} | {version} |" for name, version in sorted(fingerprint.libraries.items()))
    sources = "\n".join(f"- {line}" for line in describe_sources(catalogue))
    captured = job.captures is not None
    counts = ", ".join(f"{merged.scenes[outcome]} {outcome}" for outcome in ("made", "intrinsic", "environmental"))
    regions = (
        "neither board nor object, 2 board, 3 object" if captured else "nothing, 1 floor, 2 table, 3 and up objects"
    )
    return f"""# {job.name}

View-dependent RGB-D pairs for reconstructing objects from a single view: what a camera sees, and what the camera on the
other side sees. Made by Verso; the layout and the geometry follow {ARTICLE}.

| | |
|---|---|
| scenes | {job.first_scene} to {job.stop_scene - 1}: {counts} |
| pairs in each scene | {"at most " * captured}{job.pairs_per_scene} |
| objects in each scene | {_count(job.objects_per_scene)} |
| views of each pair | {", ".join(stored_roles(job))}{"" if job.render.rgb else "; without RGB"} |
| seed | {job.seed} |
| dataset digest | `{merged.digest}` |
| job digest | `{record.digest}` (the job is in `{JOB_FILE}`) |
| stack's fingerprint | `{fingerprint.digest}` |
| canary scene | `{fingerprint.canary}` |
| renderer | {fingerprint.renderer} |

| library | version |
|---|---|
{libraries}

{_describe_captures(job.captures, catalogue) if job.captures is not None else ""}## Shapes

{SHAPES_OF_CAPTURES if captured else sources}

Every shape, with its licence and its split by instance, is a row of the `assets` table.

## Reading it

`pyarrow.dataset.dataset("manifest/views", partitioning="hive")` has a row for each camera and the names and checksums of
its images, `manifest/objects` one for each thing that it may see; `bodies` in `manifest/scenes` says where each object lies.
Depth is 16-bit PNG, z along the optical axis, {job.images.depth_units_per_m:g} units a metre, 0 where there is none.
Masks are 8-bit PNG: 0 {regions}. Poses are camera to world, optical frame (x right,
y down, z forward), metres.
"""


def _describe_captures(captures: Captures, catalogue: "Catalogue") -> str:
    """The section on where photographs come from and what was done to them."""
    board = captures.printed_board
    origin = f"{len(catalogue.captures)} folders of photographs with registered depth, each with the board in its board.json."
    if not captures.folders:
        shapes = "\n".join(f"- {line}" for line in describe_sources(catalogue) if not line.startswith("tables"))
        origin = f"virtual, of {captures.simulate.views} views, {board.words}, and shapes from\n\n{shapes}"
    return f"""## Captures

Each scene is a capture of one object on a board of markers; its world is the board's frame. The captures are {origin}

Poses are those of the estimate `{captures.estimation.estimate}`. Input images are the photographs without their lens, and
their depth as it was measured; where the estimate determined an offset, a scale or a registration of the depth camera, depth
is corrected by it, and drawn anew from the fitted surface where the depth camera's place is. Mirror images are made of the
{captures.synthesis.views} nearest photographs, projected images of the input's.
The column `capture` of `manifest/scenes` and `manifest/views` has residuals, what was corrected, the share that was measured,
and, for virtual captures, errors against truth.

"""


def _count(count: Counts) -> str:
    return str(count.low) if count.low == count.high else f"{count.low} to {count.high}"


MOST_LICENCES = 10
"""Licences of a library that the card names, with how many shapes have them."""


def describe_sources(catalogue: "Catalogue") -> list[str]:
    """One line for each source of objects and of tables with its licence, and those of `Catalogue.describe_left_out`."""
    lines = []
    for what, sources, libraries in (
        ("objects", catalogue.assets.objects, catalogue.objects),
        ("tables", catalogue.assets.tables, catalogue.tables),
    ):
        for source, library in zip(sources, libraries, strict=True):
            if isinstance(source, ProceduralSource):
                origin = f"made from seed {source.seed}, licence CC0-1.0"
            else:
                assert library is not None
                most = ", ".join(f"{name} ({count})" for name, count in library.licences.most_common(MOST_LICENCES))
                origin = f"library {source.folder}, licences {most}"
            lines.append(f"{what}, weight {source.weight:g}: {origin}")
    return lines + catalogue.describe_left_out()
