"""MuJoCo as a referee: how far objects at rest move in another engine.

MuJoCo's contacts are soft: what rests sinks by some micrometres, and piles creep. It shows whether something falls, not
whether it is exact (docs/rest.md).
"""

import math
from collections.abc import Iterable, Sequence

import mujoco
from scipy.spatial.transform import Rotation

from schemas.base import Array, Pose
from schemas.job.physics import Physics
from schemas.scene.scene import ScenePlan
from workers.geometry.frames import invert, motion_between, pose, transform
from workers.physics.convex_parts import parts_of
from workers.physics.effects import is_convex
from workers.physics.rigid_body import body_frame

HOLD_S = 1.0

STEP_S = 5e-4
"""MuJoCo's own default is 2 ms, in which stacks sway."""

WORLD = """<mujoco><size memory="1G"/>
<option cone="elliptic" impratio="10" iterations="200" noslip_iterations="20"/>
<default><geom type="mesh" condim="6" friction="{slide} {spin} {roll}" solref="0.001 {damping}" solimp="0.99 0.999 0.001"/>
</default>
<asset>{meshes}</asset><worldbody>{bodies}</worldbody></mujoco>"""
"""Twenty steps without slip: else friction yields, and what lies on a slope creeps. Contacts as stiff as the step allows."""

CRITICAL, NO_REBOUND = 1, 2
"""Damping of contacts. At the critical one they are the stiffest, and what hits one leaves at exp(-2) = 0.14 of its speed: a
spring that pushes alone lets go there. A cube that falls by 0.2 m rises again by 3 to 5 mm, and with twice that not at all."""

BODY = """<body name="{name}" pos="{at}" quat="{turn}"><freejoint/>
<inertial pos="0 0 0" mass="{mass}" diaginertia="{moments}"/>{geoms}</body>"""


def hold_scene(plan: ScenePlan, poses: Sequence[Pose], physics: Physics) -> tuple[float, float] | None:
    """The largest motion, mm, and turn, degrees, of any object let go at its pose for `HOLD_S`; None over a table that is
    not convex, which would need parts."""
    if not plan.table.top.convex:
        return None
    after = simulate(plan, poses, physics, HOLD_S)
    motions = [
        motion_between(start.hull.vertices, T, moved)
        for start, T, moved in zip(plan.objects, poses, after, strict=True)
    ]
    moved_m, turned_rad = (max(parts) for parts in zip(*motions, strict=True))
    return moved_m * 1e3, math.degrees(turned_rad)


def simulate(
    plan: ScenePlan,
    poses: Sequence[Pose],
    physics: Physics,
    seconds: float,
    step_s: float = STEP_S,
    rebound: bool = True,
) -> list[Pose]:
    """The objects' poses after so long, let go at `poses` over a convex table; without `rebound` no impact is elastic.

    What is not convex falls as its convex parts; of files these fill hollows by millimetres.
    """
    frames = [body_frame(start.asset.mass)[0] for start in plan.objects]
    shapes = [
        [start.hull.vertices] if is_convex(start) else parts_of(start.asset, physics.concavity)
        for start in plan.objects
    ]
    placed = [T @ frame for T, frame in zip(poses, frames, strict=True)]
    model = mujoco.MjModel.from_xml_string(
        _describe(plan, placed, shapes, physics, CRITICAL if rebound else NO_REBOUND)
    )
    model.opt.timestep = step_s
    data = mujoco.MjData(model)
    for _ in range(round(seconds / step_s)):
        mujoco.mj_step(model, data)
    after = []
    for number, frame in enumerate(frames):
        body = data.body(str(number))
        after.append(pose(body.xmat.reshape(3, 3), body.xpos) @ invert(frame))
    return after


def _describe(
    plan: ScenePlan, poses: Sequence[Pose], shapes: Sequence[Sequence[Array]], physics: Physics, damping: float
) -> str:
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
    each = physics.friction_of("table")
    both = [each**2, 2.0 * each * physics.spinning_friction, 2.0 * each * physics.rolling_friction]
    slide, spin, roll = (_words([x]) for x in both)
    given = {"damping": damping, "meshes": "".join(meshes), "bodies": "".join(bodies)}
    return WORLD.format(slide=slide, spin=spin, roll=roll, **given)


def _mesh(name: str, points: Array) -> str:
    return f'<mesh name="{name}" vertex="{_words(points.reshape(-1))}"/>'


def _words(numbers: Iterable[float]) -> str:
    return " ".join(f"{x:.17g}" for x in numbers)
