"""The table of export formats: one row a format. It loads no writer, so that the command line starts at once.

To add a format: write its file, a subclass of `services.export.formats.Writer`, and add its row here.
"""

import importlib
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Format:
    """A layout that `verso export` writes."""

    module: str
    writer: str
    """The class in the module."""
    sharded: bool = False
    """Whether many pairs share a file."""

    def load(self) -> Any:
        """The class of the writer."""
        return getattr(importlib.import_module(f"{__package__}.{self.module}"), self.writer)


FORMATS = {
    "mirror-recon": Format("mirror_recon", "MirrorRecon"),
    "bop": Format("bop", "Bop"),
    "webdataset": Format("webdataset", "WebDataset", sharded=True),
    "huggingface": Format("huggingface", "HuggingFace", sharded=True),
    "gltf": Format("gltf", "Gltf"),
    "occnet": Format("occnet", "OccNet"),
    "pcn": Format("pcn", "Pcn"),
    "nocs": Format("nocs", "Nocs"),
    "nerf": Format("nerf", "Nerf"),
}
