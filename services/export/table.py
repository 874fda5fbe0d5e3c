"""The table of export formats: one row a format. It loads no writer, so that the command line starts at once.

To add a format: write a subclass of `services.export.formats.Writer`, and add its row here.
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
    "mirror-recon": Format("articles", "MirrorRecon"),
    "bop": Format("bop", "Bop"),
    "webdataset": Format("shards", "WebDataset", sharded=True),
    "huggingface": Format("shards", "HuggingFace", sharded=True),
    "gltf": Format("graphics", "Gltf"),
    "occnet": Format("objects", "OccNet"),
    "pcn": Format("objects", "Pcn"),
    "nocs": Format("articles", "Nocs"),
    "nerf": Format("graphics", "Nerf"),
    "zero123": Format("multiview", "Zero123"),
    "instantmesh": Format("multiview", "InstantMesh"),
    "trellis": Format("multiview", "Trellis"),
    "stereo": Format("multiview", "Stereo"),
}
