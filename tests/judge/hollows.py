"""Scenes of objects from files dropped into hollows from files: bowls, mugs and trays on a level table."""

import functools
import math

import numpy as np
import trimesh

from schemas.job.job import Job
from schemas.scene.scene import ScenePlan
from schemas.scene.shape import Asset
from tests.hard_cases.drops import level
from tests.hard_cases.groups import put, together
from tests.hard_cases.outside import enter, of
from tests.judge.solids import box, turned
from tests.physics.settling import scene_of
from workers.geometry.frames import uniform_rotation

CLEAR_M = 0.002
"""Between the hollow's rim and what is let go above it."""


def _bowl(radius: float, wall: float) -> trimesh.Trimesh:
    """A shell between two spheres about one middle, below it, with a level foot."""
    angles = np.linspace(math.radians(25.0), math.radians(90.0), 14)
    outer = [(radius * math.sin(a), -radius * math.cos(a)) for a in angles]
    inner = [((radius - wall) * math.sin(a), -(radius - wall) * math.cos(a)) for a in angles[::-1]]
    return _turned([(0.0, outer[0][1]), *outer, *inner, (0.0, inner[-1][1])])


def _mug(radius: float, height: float, wall: float) -> trimesh.Trimesh:
    """A beaker: a can without its lid."""
    inside = radius - wall
    return _turned([(0.0, 0.0), (radius, 0.0), (radius, height), (inside, height), (inside, wall), (0.0, wall)])


def _turned(outline: list[tuple[float, float]]) -> trimesh.Trimesh:
    mesh = turned(outline)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)


def _tray(side: float, height: float, wall: float) -> trimesh.Trimesh:
    """A box less a box."""
    outer, inner = box((side, side, height)), box((side - 2 * wall, side - 2 * wall, height), (0.0, 0.0, wall))
    return trimesh.boolean.difference([trimesh.Trimesh(each.vertices, each.faces) for each in (outer, inner)])


HOLLOWS = {
    "bowl": lambda: _bowl(0.07, 0.004),
    "thin_bowl": lambda: _bowl(0.09, 0.002),
    "mug": lambda: _mug(0.045, 0.09, 0.004),
    "tray": lambda: _tray(0.16, 0.04, 0.005),
}
CONTENTS = {
    "ball": lambda: trimesh.creation.icosphere(subdivisions=3, radius=0.015),
    "cube": lambda: trimesh.creation.box((0.025, 0.025, 0.025)),
    "can": lambda: trimesh.creation.cylinder(0.012, 0.04, sections=48),
    "brick": lambda: trimesh.creation.box((0.015, 0.03, 0.05)),
    "small_bowl": lambda: _bowl(0.03, 0.003),
}


@functools.cache
def _from_file(kind: str) -> Asset:
    """The asset of an OBJ that is written and read through the door."""
    return enter(of({**HOLLOWS, **CONTENTS}[kind]()))


def draw_hollow(job: Job, scene_id: int) -> ScenePlan:
    """A hollow, and an object turned any way above a point of its inner half: every pair of kinds in turn."""
    rng = np.random.default_rng(np.random.SeedSequence(job.seed, spawn_key=(scene_id,)))
    hollow = _from_file(list(HOLLOWS)[scene_id % len(HOLLOWS)])
    content = _from_file(list(CONTENTS)[scene_id // len(HOLLOWS) % len(CONTENTS)])
    table, size = level(), np.ptp(hollow.shape.vertices, axis=0)
    way, off_m = rng.uniform(-math.pi, math.pi), 0.25 * size[0] * math.sqrt(rng.random())
    above = put(
        content, table, size[2] + CLEAR_M, (off_m * math.cos(way), off_m * math.sin(way)), uniform_rotation(rng)
    )
    group = together(table, [put(hollow, table, 0.0005), above])
    return scene_of(group.starts, group.table)
