"""The canary scene: one small scene made from plan to encoded files, whose digest tells stacks apart."""

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

from schemas.dataset.fingerprint import Fingerprint
from schemas.job.job import Job
from schemas.job.render import Tier
from workers.assets.catalogue import open_catalogue
from workers.pipeline.context import WorkerContext, settings_digest
from workers.pipeline.make_scene import Stopwatch, make_scene
from workers.pipeline.rows import record_scene
from workers.render.raster.gbuffer import Renderer

CANARY = Job(name="canary", seed=7, scenes=1)
"""Never changed without a new schema version: a new canary makes every stored fingerprint foreign."""

CANARY_SCENE = 3

LIBRARIES = (
    "coacd",
    "embreex",
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
"""What has a hand in the bytes."""

TIER_LIBRARIES: dict[Tier, tuple[str, ...]] = {"pathtraced": ("mitsuba", "drjit")}
"""What has a hand in the bytes of one tier alone, which the canary scene is not drawn in."""

SOURCE_PACKAGES = ("schemas", "workers")
"""What of the project has a hand in the bytes: not the services that drive it."""


def take_fingerprint(renderer: Renderer, tier: Tier) -> Fingerprint:
    """The fingerprint of this process's stack, as far as a tier's bytes depend on it.

    Takes about a second, most of it Python's and GL's first use.
    """
    return Fingerprint(
        canary=canary_digest(renderer),
        code=code_digest(),
        libraries={name: version(name) for name in (*LIBRARIES, *TIER_LIBRARIES.get(tier, ()))},
        simd=numpy_simd(),
        renderer=renderer.name,
    )


def canary_digest(renderer: Renderer) -> str:
    """SHA-256, hex, of the canary scene's files and rows."""
    catalogue = open_catalogue(CANARY.assets, Path(), tuple(CANARY.categories))
    context = WorkerContext(CANARY, catalogue, renderer, settings_digest(CANARY, catalogue.digest))
    watch = Stopwatch()
    output = record_scene(context, make_scene(context, CANARY_SCENE, watch), watch)
    digest = hashlib.sha256()
    for path, data in sorted(output.files):
        digest.update(path.encode())
        digest.update(hashlib.sha256(data).digest())
    digest.update(repr(sorted(output.rows.items())).encode())
    return digest.hexdigest()


@cache
def code_digest() -> str:
    """SHA-256, hex, of the source files that have a hand in the bytes, by path."""
    root = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for path in sorted(path for package in SOURCE_PACKAGES for path in (root / package).rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def numpy_simd() -> str:
    """The instruction sets that numpy chooses from at run time and may use here, widest last."""
    numbers = np._core._multiarray_umath  # type: ignore[attr-defined]
    enabled = [name for name in numbers.__cpu_dispatch__ if numbers.__cpu_features__[name]]
    return " ".join([*numbers.__cpu_baseline__[-1:], *enabled])
