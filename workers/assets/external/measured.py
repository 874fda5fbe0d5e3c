"""What a person asks about a file of a source: size, faces, closed or not, textures, how it stands."""

import json
from dataclasses import asdict, dataclass

import numpy as np

from schemas.job.assets import UpAxis
from schemas.scene.shape import Asset, Hull
from workers.assets.external.upright import Confidence, find_upright

PLACEHOLDER_PX = 2
"""Side of the grey picture that trimesh gives a mesh whose material is missing."""


@dataclass(frozen=True)
class Measured:
    """One file: sizes along its own axes, in units of its source's `scale`; what was mended, left out or is missing.

    textures: how many pictures its parts have. up, confidence: what its shape tells about the axis that is up, or None.
    """

    extents: tuple[float, float, float]
    vertices: int
    faces: int
    watertight: bool
    textures: int
    notes: tuple[str, ...]
    up: UpAxis | None = None
    confidence: Confidence | None = None


def measure_asset(asset: Asset, hull: Hull | None) -> str:
    """The measures of an asset whose source has z up, as JSON."""
    extents = asset.extents_m
    textures = [part.material.texture for part in asset.shape.parts if part.material.texture is not None]
    pictures = {id(texture) for texture in textures if max(texture.shape[:2]) > PLACEHOLDER_PX}
    found = None if hull is None else find_upright(hull.vertices, asset.mass.com)
    return json.dumps(
        asdict(
            Measured(
                extents=(float(extents[0]), float(extents[1]), float(extents[2])),
                vertices=int(np.sum([len(part.vertices) for part in asset.shape.parts])),
                faces=int(np.sum([len(part.faces) for part in asset.shape.parts])),
                watertight=asset.watertight,
                textures=len(pictures),
                notes=asset.notes,
                up=None if found is None else found.axis,
                confidence=None if found is None else found.confidence,
            )
        )
    )


def read_measured(data: bytes) -> Measured:
    """The measures of `measure_asset`'s JSON. Raises ValueError, TypeError or KeyError where it is none."""
    tree = json.loads(data)
    return Measured(**{**tree, "extents": tuple(tree["extents"]), "notes": tuple(tree["notes"])})
