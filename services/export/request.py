"""What an export is asked for: a dataset, a place, a format by name, and a choice of scenes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from services.export.choice import EVERYTHING, Choice
from workers.store.store import Store

FormatName = Literal["mirror-recon", "bop", "webdataset", "huggingface", "gltf"]
FORMATS: tuple[FormatName, ...] = get_args(FormatName)
SHARDED: tuple[FormatName, ...] = ("webdataset", "huggingface")
"""Formats of which many pairs share a file."""


@dataclass(frozen=True, eq=False)
class ExportRequest:
    """What to export, where to, and how."""

    store: Store
    target: Path
    format: FormatName
    choice: Choice = EVERYTHING
    shard_mb: int = 256
    """Size that ends a shard, of formats that have shards; 10^6 bytes."""
