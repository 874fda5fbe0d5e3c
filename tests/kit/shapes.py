"""Simple assets with mass properties from trimesh, for tests without a catalogue."""

from typing import Any

import numpy as np
import trimesh

from schemas.base import frozen_array
from schemas.scene.shape import Asset, MassProperties, Material, Part, Shape


def shape_of(*meshes: trimesh.Trimesh) -> Shape:
    """A shape with a part for each mesh."""
    return Shape(
        tuple(
            Part(f"part{k}", frozen_array(m.vertices), frozen_array(m.faces, np.int32), Material())
            for k, m in enumerate(meshes)
        )
    )


def asset_of(*meshes: trimesh.Trimesh, category: str = "box", mass_kg: float = 0.5) -> Asset:
    """An asset in the meshes' own frame; its mass properties are those of the solid that they enclose together."""
    whole: Any = trimesh.util.concatenate(list(meshes))
    mass = MassProperties(
        mass_kg, frozen_array(whole.center_mass), frozen_array(whole.moment_inertia * mass_kg / whole.volume), True
    )
    return Asset(
        instance_id=f"{category}-test",
        category=category,
        source="test",
        licence="CC0-1.0",
        path=None,
        sha256="0" * 64,
        shape=shape_of(*meshes),
        mass=mass,
        T_source_to_object=frozen_array(np.eye(4)),
        scale=1.0,
        watertight=True,
        volume_m3=float(whole.volume),
        shareable=True,
    )


def box(x: float, y: float, z: float, at: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    """An axis-aligned box of these sides about `at`."""
    mesh = trimesh.creation.box((x, y, z))
    mesh.apply_translation(at)
    return mesh


def table(side_m: float = 1.4, height_m: float = 0.7, thick_m: float = 0.03) -> Asset:
    """A square table on four legs, its frame's origin at the centre of its bounding box."""
    half, leg = height_m / 2, side_m / 2 - 0.1
    top = box(side_m, side_m, thick_m, (0, 0, half - thick_m / 2))
    legs = [box(0.05, 0.05, height_m - thick_m, (x, y, -thick_m / 2)) for x in (-leg, leg) for y in (-leg, leg)]
    return asset_of(top, *legs, category="table", mass_kg=20.0)
