"""The fingerprint of a stack: the digest of one small scene, versions of libraries, and the code."""

import hashlib
import math
import platform
from collections.abc import Sequence
from importlib.metadata import distribution, version
from itertools import pairwise
from operator import attrgetter
from pathlib import Path

import numpy as np
from zlib_ng import zlib_ng

from schemas.dataset.shard import Fingerprint
from schemas.job.job import Job, settings_digest
from schemas.job.views import Tier
from workers.assets.catalogue import open_catalogue
from workers.geometry.frames import pose, rotation_about
from workers.physics.bullet import bullet_file, open_world
from workers.physics.rigid_body import Body
from workers.render.raster.gbuffer import Renderer
from workers.scene.context import WorkerContext
from workers.scene.make_scene import make_scene
from workers.scene.rows import record_scene
from workers.source import code_digest
from workers.stopwatch import Stopwatch

CANARY = Job(name="canary", seed=7, scenes=1)
"""Changed with the schema version only: a new canary makes every stored fingerprint foreign."""

CANARY_SCENE = 3

BULLET_STEPS = 20
"""Steps between two states of `bullet_digest`: eight states are 0.17 s, in which all three boxes have met."""

LIBRARIES = (
    "embreex",
    "fpng",
    "llvmlite",
    "manifold3d",
    "numba",
    "numpy",
    "opencv-contrib-python-headless",
    "pillow",
    "pybullet",
    "pyrender",
    "scipy",
    "trimesh",
    "zlib-ng",
)
"""Libraries that the bytes depend on."""

TIER_LIBRARIES: dict[Tier, tuple[str, ...]] = {"pathtraced": ("mitsuba", "drjit")}
"""Libraries that the bytes of one tier depend on; the canary scene is not drawn in it."""


LIBM = (math.sin, math.cos, math.tan, math.atan, math.sinh, math.tanh, math.cbrt, math.expm1, math.log1p)
"""Functions of the C library, of one number of any size."""


def take_fingerprint(renderer: Renderer, tier: Tier) -> Fingerprint:
    """The fingerprint of this process's stack, as far as a tier's bytes depend on it.

    Takes about a second, most of it Python's and GL's first use.
    """
    names = (*LIBRARIES, *TIER_LIBRARIES.get(tier, ()))
    return Fingerprint(
        canary=canary_digest(renderer),
        code=code_digest(),
        libraries={name: version(name) for name in names},
        simd=numpy_simd(),
        renderer=renderer.name,
        maths=maths_digest(),
        python=f"{platform.python_implementation()} {platform.python_version()}",
        binaries=binaries_digest(names, bullet_file()),
    )


def binaries_digest(names: Sequence[str], loaded: str) -> str:
    """SHA-256, hex, of how libraries were built: what they say of the shared libraries that were installed, and a loaded one.

    Wheels and what pip builds itself list each file's SHA-256. `loaded` is read as a whole, by a check sum and its size: 133 MB
    take some 30 ms.
    """
    digest = hashlib.sha256()
    for name in names:
        lines = (distribution(name).read_text("RECORD") or "").splitlines()
        digest.update("\n".join(sorted(line for line in lines if ".so" in line.partition(",")[0])).encode())
    check = 0
    with open(loaded, "rb") as file:
        while block := file.read(1 << 20):
            check = zlib_ng.crc32(block, check)
        digest.update(f"{check} {file.tell()}".encode())
    return digest.hexdigest()


def bullet_digest() -> str:
    """SHA-256, hex, of the states of two boxes that are thrown, spinning, onto a third one in flight, in PyBullet.

    The canary scene lands upright and is brought to exact rest: its poses need not show how PyBullet was built.
    """
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * (0.03, 0.04, 0.05)
    body = Body(0.6, np.array([8.2e-4, 6.8e-4, 5.0e-4]), (corners,))
    axis, digest = np.array([0.6, 0.0, 0.8]), hashlib.sha256()
    places = [pose(rotation_about(axis, 0.7 * k), np.array([0.01 * k, 0.0, 0.06 + 0.1 * k])) for k in range(3)]
    with open_world([(body, place) for place in places], 0.0, CANARY.physics, BULLET_STEPS) as world:
        for number in (1, 2):
            world.set_velocity((0.3, -0.1 * number, -1.0), (7.0, 3.0 * number, -5.0), number)
        for _ in range(8):
            world.advance()
            digest.update(repr([(world.pose(number), world.velocity(number)) for number in range(3)]).encode())
    return digest.hexdigest()


def canary_digest(renderer: Renderer) -> str:
    """SHA-256, hex, of the canary scene's files and rows, and of PyBullet's states in a pile that falls."""
    catalogue = open_catalogue(CANARY.assets, Path(), tuple(CANARY.categories))
    context = WorkerContext(CANARY, catalogue, renderer, settings_digest(CANARY, catalogue.digest))
    stopwatch = Stopwatch()
    output = record_scene(context, make_scene(context, CANARY_SCENE, stopwatch), stopwatch)
    digest = hashlib.sha256()
    for file in sorted(output.files, key=attrgetter("path")):
        digest.update(file.path.encode())
        digest.update(bytes.fromhex(file.sha256))
    digest.update(repr(sorted(output.rows.items())).encode())
    digest.update(bullet_digest().encode())
    return digest.hexdigest()


def maths_digest() -> str:
    """SHA-256, hex, of elementary functions, sums, products and decompositions of fixed numbers, in 10 ms.

    The C library chooses its own by the processor: without fused multiplication, scenes differ in their last bits.
    """
    numbers = [0.05 + 0.0037 * step for step in range(2000)]
    one = [function(x) for function in (*LIBM, math.exp, math.log, math.sqrt) for x in numbers]
    one += [sum(numbers[:count]) for count in range(2, 200)]  # which Python 3.12 rounds once and 3.11 at every term
    two = [function(x, y) for function in (math.atan2, math.pow, math.hypot) for x, y in pairwise(numbers)]
    array = np.array(numbers)
    several = [function(array) for function in (np.exp, np.log, np.sin, np.cos, np.arctan)]
    matrix = np.sin(np.array(numbers[:1600])).reshape(40, 40)
    several += [matrix @ matrix.T, np.linalg.inv(matrix + 40 * np.eye(40)), np.linalg.svd(matrix)[1]]
    digest = hashlib.sha256(np.array([*one, *two]).tobytes())
    for values in several:
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def numpy_simd() -> str:
    """The instruction sets that numpy chooses from at run time and may use here, widest last."""
    numbers = np._core._multiarray_umath  # type: ignore[attr-defined]
    enabled = [name for name in numbers.__cpu_dispatch__ if numbers.__cpu_features__[name]]
    return " ".join([*numbers.__cpu_baseline__[-1:], *enabled])
