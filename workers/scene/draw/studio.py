"""A studio scene: one object alone, on nothing, in even light. There is no table, no floor, no fall and no shadow."""

import math
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from schemas.base import Array, frozen_array
from schemas.job.job import Job
from schemas.job.views import Studio
from schemas.scene.scene import ObjectStart, ScenePlan, Settled
from schemas.scene.shape import REGION_FIRST_OBJECT, Asset, MassProperties, Shape
from workers.assets.look.appearance import studio_light
from workers.geometry.frames import UP, pose, rotation_about, uniform_rotation
from workers.geometry.hull import hull_of
from workers.scene.cameras import draw_camera
from workers.scene.chance import SceneChance, Stream


def draw_studio(job: Job, chance: SceneChance, asset: Asset) -> ScenePlan:
    """The plan of a studio scene of this asset: its box's middle is the world's origin."""
    asset = scaled_to(asset, job.studio)
    T = frozen_array(pose(_turn(job.start.pose, chance), np.zeros(3)))
    rng, further = chance.stream(Stream.CAMERA), chance.stream(Stream.ORBIT)
    return ScenePlan(
        scene_id=chance.scene_id,
        category=asset.category,
        ground=None,
        objects=(ObjectStart(asset, hull_of(asset.shape), REGION_FIRST_OBJECT, T, 0, True),),
        input_cameras=tuple(draw_camera(rng, further, job.cameras, np.zeros(3)) for _ in range(job.pairs_per_scene)),
        appearance=studio_light(job.studio),
    )


def stand_alone(plan: ScenePlan) -> tuple[Settled, ...]:
    """Every object where it was put: nothing moves it, nothing carries it, and it has no figures of rest."""
    unknown = math.nan
    return tuple(
        Settled(start.T_world_obj, unknown, unknown, unknown, unknown, unknown, unknown, "nothing")
        for start in plan.objects
    )


def _turn(how: str, chance: SceneChance) -> Array:
    """The rotation [3, 3] of the object."""
    rng = chance.object_stream(Stream.START, 0)
    if how == "tumbled":
        return uniform_rotation(rng)
    return rotation_about(UP, float(rng.uniform(-np.pi, np.pi))) if how == "upright" else np.eye(3)


_scaled: WeakKeyDictionary[Asset, dict[float, Asset]] = WeakKeyDictionary()
"""Assets at other sizes, as long as the asset is kept: the renderer keeps what it uploads of a shape by its identity."""


def scaled_to(asset: Asset, studio: Studio) -> Asset:
    """The asset at the size that the job asks for; its density stays."""
    if studio.scale == "metric":
        return asset
    reach_m = (
        np.linalg.norm(asset.shape.vertices, axis=1).max() if studio.scale == "unit_sphere" else asset.extents_m.max()
    )
    factor = studio.size_m / float(reach_m)
    sizes = _scaled.setdefault(asset, {})
    if factor not in sizes:
        sizes[factor] = _scale(asset, factor)
    return sizes[factor]


def _scale(asset: Asset, factor: float) -> Asset:
    parts = [replace(part, vertices=frozen_array(factor * part.vertices)) for part in asset.shape.parts]
    mass, T = asset.mass, asset.T_source_to_object.copy()
    T[:3, 3] *= factor
    heavier = factor**3 if mass.solid else factor**2  # a shell's mass goes with its surface
    return replace(
        asset,
        shape=Shape(tuple(parts), asset.shape.closed),
        mass=MassProperties(heavier * mass.mass_kg, factor * mass.com, heavier * factor**2 * mass.inertia, mass.solid),
        T_source_to_object=frozen_array(T),
        scale=factor * asset.scale,
        volume_m3=None if asset.volume_m3 is None else asset.volume_m3 * factor**3,
        lofted=None,
    )
