"""MuJoCo as a referee: how far objects at rest move in another engine, where the extra `audit` is installed.

MuJoCo's contacts are soft: what rests sinks by some micrometres, and piles creep. It shows whether something falls, not
whether it is exact (docs/rest.md).
"""

import importlib
import importlib.util
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from scipy.spatial.transform import Rotation

from schemas.base import Array, Pose
from schemas.errors import plural
from schemas.job.physics import Physics
from schemas.scene.scene import ObjectStart, ScenePlan, Settled
from workers.geometry.frames import invert, motion_between, pose, transform
from workers.physics.convex_parts import parts_of
from workers.physics.effects import is_convex
from workers.physics.rigid_body import body_frame

HOLD_S = 1.0

STEP_S = 5e-4
"""MuJoCo's own default is 2 ms, in which stacks sway."""

WORLD = """<mujoco><size memory="1G"/>
<option cone="elliptic" impratio="10" iterations="200" noslip_iterations="20"/>
<default><geom type="mesh" condim="6" friction="{slide} {spin} {roll}" solref="0.001 1" solimp="0.99 0.999 0.001"/></default>
<asset>{meshes}</asset><worldbody>{bodies}</worldbody></mujoco>"""
"""Twenty steps without slip: else friction yields, and what lies on a slope creeps. Contacts as stiff as the step allows."""

BODY = """<body name="{name}" pos="{at}" quat="{turn}"><freejoint/>
<inertial pos="0 0 0" mass="{mass}" diaginertia="{moments}"/>{geoms}</body>"""


@dataclass(frozen=True)
class Held:
    """The largest motion and turn of any object, and how many were held as what, with the reason."""

    moved_mm: float = 0.0
    turned_deg: float = 0.0
    scenes: int = 0
    shapes: dict[str, int] = field(default_factory=dict)

    def join(self, other: "Held") -> "Held":
        """The larger motion, and the sum of what was held."""
        return Held(
            max(self.moved_mm, other.moved_mm),
            max(self.turned_deg, other.turned_deg),
            self.scenes + other.scenes,
            dict(Counter(self.shapes) + Counter(other.shapes)),
        )


def describe_held(held: Held | None) -> str:
    """What an audit says of it, in a line."""
    if held is None:
        return "  no second engine held the scenes: MuJoCo is not installed (`./verso extra audit`)"
    shapes = "; ".join(f"{plural(count, 'object')} {what}" for what, count in sorted(held.shapes.items()))
    return (
        f"  MuJoCo held {plural(held.scenes, 'scene')} for {HOLD_S:g} s: moved at most {held.moved_mm:.4f} mm, turned at most "
        f"{held.turned_deg:.5f} degrees ({shapes or 'the tables are not convex'})"
    )


def is_installed() -> bool:
    """Whether MuJoCo can be imported."""
    return importlib.util.find_spec("mujoco") is not None


def hold_scene(plan: ScenePlan, settled: Sequence[Settled], physics: Physics) -> Held | None:
    """Hold a scene for `HOLD_S` from where it rests; None over a table that is not convex, which would need parts."""
    if not plan.table.top.convex:
        return None
    poses = [one.T_world_obj for one in settled]
    after, shapes = simulate(plan, poses, physics, HOLD_S)
    held = Held(scenes=1, shapes=dict(Counter(shapes)))
    for start, T, moved in zip(plan.objects, poses, after, strict=True):
        moved_m, turned_rad = motion_between(start.hull.vertices, T, moved)
        held = held.join(Held(moved_m * 1e3, math.degrees(turned_rad)))
    return held


def simulate(
    plan: ScenePlan, poses: Sequence[Pose], physics: Physics, seconds: float, step_s: float = STEP_S
) -> tuple[list[Pose], list[str]]:
    """The objects' poses after so long, let go at `poses` over a convex table; and what stands for each of them."""
    mujoco: Any = importlib.import_module("mujoco")
    frames = [body_frame(start.asset.mass)[0] for start in plan.objects]
    shapes = [_convex_parts(start, physics) for start in plan.objects]
    placed = [T @ frame for T, frame in zip(poses, frames, strict=True)]
    model = mujoco.MjModel.from_xml_string(_describe(plan, placed, [parts for parts, _ in shapes], physics))
    model.opt.timestep = step_s
    data = mujoco.MjData(model)
    for _ in range(round(seconds / step_s)):
        mujoco.mj_step(model, data)
    after = []
    for number, frame in enumerate(frames):
        body = data.body(str(number))
        after.append(pose(body.xmat.reshape(3, 3), body.xpos) @ invert(frame))
    return after, [what for _, what in shapes]


def _convex_parts(start: ObjectStart, physics: Physics) -> tuple[Sequence[Array], str]:
    """The vertices of the parts that stand for an object, in its frame, and what they are."""
    if is_convex(start):
        return [start.hull.vertices], "as meshes, being convex"
    parts = parts_of(start.asset, physics.concavity)
    if len(parts) == 1:
        return parts, "as hulls, because they cannot be cut into parts"
    if start.asset.lofted is None:
        return parts, "as halved parts, which fill hollows by millimetres, being from files and not convex"
    return parts, "as parts from their making, not being convex"


def _describe(plan: ScenePlan, poses: Sequence[Pose], shapes: Sequence[Sequence[Array]], physics: Physics) -> str:
    """The scene's MJCF: each body in its centre of mass and principal axes, and the table as its hull."""
    meshes, bodies = [_mesh("table", plan.table.mesh.vertices)], ['<geom mesh="table"/>']
    for number, (start, T, parts) in enumerate(zip(plan.objects, poses, shapes, strict=True)):
        frame, moments = body_frame(start.asset.mass)
        inward = invert(frame)
        meshes += [_mesh(f"{number}_{k}", transform(inward, part)) for k, part in enumerate(parts)]
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        bodies.append(
            BODY.format(
                name=number,
                at=_words(T[:3, 3]),
                turn=_words((w, x, y, z)),
                mass=_words([start.asset.mass.mass_kg]),
                moments=_words(moments),
                geoms="".join(f'<geom mesh="{number}_{k}"/>' for k in range(len(parts))),
            )
        )
    # Bullet multiplies the bodies' coefficients, and doubles the product of rolling friction and friction.
    both = [physics.friction**2] + [
        2.0 * physics.friction * x for x in (physics.spinning_friction, physics.rolling_friction)
    ]
    slide, spin, roll = (_words([x]) for x in both)
    return WORLD.format(slide=slide, spin=spin, roll=roll, meshes="".join(meshes), bodies="".join(bodies))


def _mesh(name: str, points: Array) -> str:
    return f'<mesh name="{name}" vertex="{_words(points.reshape(-1))}"/>'


def _words(numbers: Iterable[float]) -> str:
    return " ".join(f"{x:.17g}" for x in numbers)
