"""The formats of `verso export`, by name; each is loaded when it is asked for."""

from typing import Any

from services.export.folder import ExportFolder
from services.export.request import ExportRequest, FormatName
from services.export.writer import Writer
from services.job.record import JobRecord


def open_writer(
    name: FormatName, request: ExportRequest, record: JobRecord, folder: ExportFolder, state: dict[str, Any] | None
) -> Writer:
    """The writer of a format; `state` is what it said at the last checkpoint, None where it begins."""
    most_bytes = 1_000_000 * request.shard_mb
    match name:
        case "mirror-recon":
            from services.export.mirror_recon import MirrorRecon

            return MirrorRecon(folder, state)
        case "bop":
            from services.export.bop import Bop

            return Bop(request.store, record, folder, state)
        case "webdataset":
            from services.export.webdataset import WebDataset

            return WebDataset(folder, most_bytes, state)
        case "huggingface":
            from services.export.huggingface import HuggingFace

            return HuggingFace(record, folder, most_bytes, state)
        case "gltf":
            from services.export.gltf import Gltf

            return Gltf(request.store, record, folder, state)
