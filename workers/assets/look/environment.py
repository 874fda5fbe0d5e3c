"""Edge: the maps of light that a job names (`look.environment`), each read once by a limited process and kept small.

What is kept of a map is its picture at 1024 x 512, its irradiance as harmonics, and its bright parts as lights, all at the
exposure of the drawn studio: a level white surface is just below what clips.
"""

import hashlib
import io
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from schemas.base import frozen_array
from schemas.environment import cache_folder
from schemas.errors import AssetSourceError, InputError, MeshError
from schemas.job.look import MOST_LIGHTS
from schemas.scene.shape import Appearance, Light, MapSource, Surround
from workers.assets.look.appearance import ALBEDO_IN_LIGHT
from workers.assets.look.lights import DrawnEnvironment, DrawnLights, rgb
from workers.assets.look.skies import HEIGHT, make_sky
from workers.door.opening import read_bytes
from workers.door.radiance import MOST_BYTES, read_radiance
from workers.geometry.frames import UP, rotation_about
from workers.geometry.irradiance import (
    LUMINANCE,
    WORK_PX,
    LightMap,
    Map,
    even_directions,
    fit_light,
    irradiance,
    reduce_map,
    turn_polynomials,
)
from workers.pool import Answers, Ended, Limits, run_pool
from workers.source import code_digest

MOST_EXPOSED = 2.0
"""Light on a white surface, wherever it faces: a low sun would leave nothing but white else."""

MOST_MAPS = 1000
LIMITS = Limits(memory_mb=2048, cpu_s=120.0)
REFUSAL = b"-"


def expose_map(radiance: Map) -> LightMap:
    """The light of a map, scaled so that a level white surface has `ALBEDO_IN_LIGHT`, and none more than `MOST_EXPOSED`."""
    radiance = np.asarray(radiance / radiance.mean(dtype=np.float64), np.float32)
    normals = np.concatenate([np.array([UP]), even_directions(500)])
    received = irradiance(reduce_map(radiance, WORK_PX), normals) @ LUMINANCE
    scale = min(ALBEDO_IN_LIGHT / max(received[0], 1e-6), MOST_EXPOSED / received.max())
    return fit_light(np.asarray(radiance * np.float32(scale), np.float32), MOST_LIGHTS)


def open_maps(name: str | None, job_folder: Path) -> tuple[MapSource, ...]:
    """The maps of a folder in order of their names, each read once. Raises AssetSourceError naming what cannot be used."""
    if name is None:
        return ()
    folder, key = (job_folder / Path(name).expanduser()).resolve(), "look.environment.folder"
    try:
        every = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise AssetSourceError(f"{key}: {folder} cannot be read: {error.strerror or error}") from error
    paths = [path for path in every if path.suffix.lower() in (".hdr", ".exr")]
    if not 0 < len(paths) <= MOST_MAPS:
        there = f" but {', '.join(path.name for path in every[:3])}" if every and not paths else ""
        raise AssetSourceError(
            f"{key}: {folder} has {len(paths) or 'no'} maps (.hdr, .exr){there}: give 1 to {MOST_MAPS}"
        )
    try:
        maps = tuple(
            MapSource(path.name, path, hashlib.sha256(read_bytes(path, MOST_BYTES)).hexdigest()) for path in paths
        )
    except InputError as error:
        raise AssetSourceError(f"{key}: {error}") from error
    refused = [(file.path, message) for file, answer in _answers(maps) if (message := _refusal(answer, file))]
    if refused:
        more = f"; and {len(refused) - 1} more of {len(maps)} maps" if len(refused) > 1 else ""
        raise AssetSourceError(f"{key}: {min(refused)[1]}{more}")
    return maps


@lru_cache(maxsize=8)  # 6 MB each
def load_map(source: MapSource) -> LightMap:
    """The light of a map or of a built-in sky or room. Raises MeshError where its file is gone or is another now."""
    if source.path is None:
        return expose_map(make_sky(source.name))
    ((_, answer),) = _answers([source])
    if message := _refusal(answer, source):
        raise MeshError("missing", message, "environmental")
    assert isinstance(answer, bytes)
    with np.load(io.BytesIO(answer), allow_pickle=False) as held:
        return LightMap(**held)


def _refusal(answer: bytes | Ended, file: MapSource) -> str | None:
    if isinstance(answer, Ended):
        return f"{file.path} {answer.detail}: scale it down, or take it out"
    return answer[len(REFUSAL) :].decode() if answer.startswith(REFUSAL) else None


def _answers(files: Iterable[MapSource]) -> Iterator[tuple[MapSource, bytes | Ended]]:
    """Files with what is kept of them; those that this machine does not know yet are read by limited processes."""
    unknown, folder = [], cache_folder("maps")
    kept = {file: Answers(None if folder is None else folder / str(file.sha256)) for file in files}
    for file in files:
        if (known := kept[file].get(code_digest())) is None:
            unknown.append(file)
        else:
            yield file, known
    for file, answer in run_pool(answer_map, unknown, limits=LIMITS):
        if isinstance(answer, bytes) and not answer.startswith(REFUSAL):
            kept[file].put(code_digest(), answer)
        yield file, answer


def answer_map(file: MapSource) -> bytes:
    """In a limited process: the light of a map as an archive of arrays, or why it is refused."""
    assert file.path is not None and file.sha256 is not None
    try:
        light = expose_map(read_radiance(file.path, file.sha256, HEIGHT))
    except InputError as error:
        return REFUSAL + str(error).encode()
    stream = io.BytesIO()
    np.savez(stream, **vars(light))
    return stream.getvalue()


def relight(
    base: Appearance, lights: DrawnLights | None, environment: DrawnEnvironment | None, shown: bool
) -> Appearance:
    """The appearance with drawn lights, with a map in the place of all other light, or both.

    The light that gives most to a level surface comes first: it casts shadows in tier raster. `shown`: whether the map is seen
    where no surface is.
    """
    drawn, rest = base.lights, 1.0
    if lights is not None:
        base, drawn, rest = replace(base, ambient=lights.ambient, below=lights.below), lights.lights, lights.rest
    elif environment is not None:
        drawn = ()
    if environment is not None:
        light, R = load_map(environment.source), rotation_about(UP, environment.turn_rad)
        most = MOST_LIGHTS - len(drawn)
        terms = frozen_array(turn_polynomials(rest * (light.terms - light.of_lights[:most].sum(axis=0)), R))
        parts = zip(light.towards[:most] @ R.T, rest * light.colors, light.sizes_rad.tolist(), strict=False)
        every = [*drawn, *(Light(frozen_array(n), rgb(color), size, True) for n, color, size in parts)]
        every.sort(key=lambda each: -float(np.dot(each.color, LUMINANCE)) * each.direction[2])
        # A dark one keeps the maps of occlusion where nothing is bright.
        drawn = tuple(every) or (Light(frozen_array(UP), (0.0, 0.0, 0.0), None, True),)
        base = replace(base, surround=Surround(light.radiance, terms, environment.turn_rad, rest, shown))
    return base if drawn is base.lights else replace(base, lights=drawn)
