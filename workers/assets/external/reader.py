"""Edge: reads files from outside in limited processes, which a file may end but whose end harms nobody else.

multiprocessing's fork server has imported everything once and starts a child for each batch of tasks. The child sets its limits,
answers each task with one message through a pipe, and ends. What it answered before a crash is kept, and the rest goes to
another child; a file is blamed only where it was the first that its child read. Messages are bytes, JSON and arrays in numpy's
file format, and never pickle, because they come from a process that has read a stranger's file.
"""

import ctypes
import errno
import gc
import io
import json
import multiprocessing
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from math import ceil
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import QhullError

from schemas.base import frozen_array
from schemas.errors import MachineError, MeshError
from schemas.job.assets import TABLE, Assets, FolderSource, MeshLimits, ShapeNetSource
from schemas.scene.shape import Asset, Hull, MassProperties, Material, Part, Shape
from workers.assets.external.listing import Entry, hash_files
from workers.assets.external.placement import (
    THINNEST,
    find_doubt,
    list_files,
    load_entry,
    measure_asset,
    measure_thinness,
)
from workers.door.meshes.caps import describe_error, one_line
from workers.door.meshes.urdf import list_named
from workers.geometry.hull import convex_hull

Kind = Literal["list", "check", "load", "measure", "names"]

BATCH: dict[Kind, int] = {"list": 128, "names": 128, "check": 32, "measure": 32, "load": 1}
"""Tasks that one child works on: a child costs some milliseconds, and one that ends is replaced for what is left."""

MOST_PROCESSES = 8
"""Processes that read a source in parallel: each may take the memory that the limits allow."""

NO_MEMORY = 12
"""Exit code of a child that had no memory left."""

PR_SET_PDEATHSIG = 1
"""The option of prctl(2) by which a child ends with its parent."""

ANSWER, REFUSAL = b"+", b"-"
"""The first byte of a message."""

Watch = Callable[[int, int], None]
"""Is told how many tasks of how many are done."""


@dataclass(frozen=True)
class Task:
    """One question about one asset of a source.

    By the `path` of its first file: `list`, all its files; `names`, what a URDF refers to. By an `entry`: `check`, whether it
    can be used; `load`, all of it; `measure`, what a person asks about it.
    """

    kind: Kind
    path: Path
    category: str = ""
    entry: Entry | None = None


@dataclass(frozen=True)
class Request:
    """Tasks of one kind about one source, whose folder is `folder`; `assets` has the limits and the densities."""

    settings: ShapeNetSource | FolderSource
    folder: Path
    assets: Assets
    tasks: tuple[Task, ...]


def ask(request: Request) -> Iterator[bytes | MeshError]:
    """For each task what it answers, or why its file is refused, in their order.

    Raises MachineError where no process can be started, or one was killed from outside.
    """
    left = request.tasks
    while left:
        answers, code = _exchange(replace(request, tasks=left))
        if code in (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP):
            raise MachineError("a process that reads meshes was killed from outside, perhaps for want of memory")
        if not answers:  # it ended in the first task and had read nothing before: the verdict is the file's own
            answers = [_describe_end(code, left[0].path, request.assets.limits)]
        yield from answers
        left = left[len(answers) :]


def ask_all(request: Request, watch: Watch) -> Iterator[tuple[Task, bytes | MeshError]]:
    """Every task with its answer, in their order, by as many processes at once as there are cores."""
    tasks = request.tasks
    if not tasks:
        return
    size, done = BATCH[tasks[0].kind], 0
    batches = iter([replace(request, tasks=tasks[at : at + size]) for at in range(0, len(tasks), size)])
    count = min(len(os.sched_getaffinity(0)), MOST_PROCESSES)

    def ask_batch(batch: Request) -> list[tuple[Task, bytes | MeshError]]:
        return list(zip(batch.tasks, ask(batch), strict=True))

    with ThreadPoolExecutor(count) as pool:
        waiting = [pool.submit(ask_batch, batch) for batch in islice(batches, 2 * count)]
        while waiting:
            answers = waiting.pop(0).result()
            waiting += [pool.submit(ask_batch, batch) for batch in islice(batches, 1)]
            yield from answers
            done += len(answers)
            watch(done, len(tasks))


_processes = multiprocessing.get_context("forkserver")
_processes.set_forkserver_preload([__name__])
_lock = threading.Lock()
"""Held while a child is started or joined: multiprocessing looks after its children in whichever thread starts the next."""


def _exchange(request: Request) -> tuple[list[bytes | MeshError], int]:
    """Answers up to the task in which the child ended, and its exit code, negative for a signal."""
    for _ in range(2):  # the fork server may have been killed
        source, sink = _processes.Pipe(duplex=False)
        child = _processes.Process(target=_work, args=(request, sink), daemon=True)
        with source:
            with sink, suppress(OSError, EOFError):
                _start(child)
            answers: list[bytes | MeshError] = []
            with suppress(EOFError, OSError):
                while child.pid is not None:
                    answers.append(_open_answer(source.recv_bytes(request.assets.limits.max_memory_mb << 20)))
        if child.pid is not None:
            with _lock:
                child.join()
            assert child.exitcode is not None
            if child.exitcode != LOST_SERVER:
                return answers, child.exitcode
    raise MachineError("the process that reads meshes ends at once: see the lines above, and `verso doctor`")


LOST_SERVER = 255
"""The exit code that multiprocessing gives a child whose fork server has ended."""


def _start(child: Any) -> None:
    """Starts a child without this process's main module, which it does not need: a script without a guard would run again."""
    with _lock:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            child.start()
        finally:
            sys.modules["__main__"] = main


def _open_answer(message: bytes) -> bytes | MeshError:
    if message[:1] == ANSWER:
        return message[1:]
    reason, detail, kind = json.loads(message[1:])
    error = MeshError(reason, detail)
    error.kind = kind
    return error


def _describe_end(code: int, path: Path, limits: MeshLimits) -> MeshError:
    """Why a child ended, in terms of the file that it was reading."""
    if code == -signal.SIGXCPU:
        more = f"takes more than assets.limits.max_cpu_s = {limits.max_cpu_s:g} s of processor time"
        return MeshError("too_slow", f"{path} {more}: make it simpler, or raise the limit")
    if code == NO_MEMORY:
        more = f"takes more memory than assets.limits.max_memory_mb = {limits.max_memory_mb}"
        return MeshError("too_large", f"{path} {more}: make it simpler, or raise the limit")
    how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return MeshError("unreadable", f"{path} crashes the process that reads it ({how})")


def _work(request: Request, answers: Connection) -> NoReturn:
    """In the child: answers every task under the limits, and exits."""
    code = 1
    try:
        _set_limits(request.assets.limits.max_memory_mb << 20)
        for task in request.tasks:
            # Processor time, so that the verdict is the same on a busy machine; for each task alone, not for the batch.
            most = ceil(time.process_time() + request.assets.limits.max_cpu_s)
            resource.setrlimit(resource.RLIMIT_CPU, (most, resource.RLIM_INFINITY))
            answers.send_bytes(answer_task(request, task))
        code = 0
    except MemoryError:
        code = NO_MEMORY
    except OSError as error:
        code = NO_MEMORY if error.errno in (errno.ENOMEM, errno.EFBIG) else 1
    finally:
        os._exit(code)


def _set_limits(most_bytes: int) -> None:
    """In the child: ends with the fork server, says nothing, leaves no core, and has so much address space and file size."""
    gc.freeze()  # the collector would copy every page of what was imported
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that asks decides when to stop
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    for standard in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), standard)
    for limit in (resource.RLIMIT_AS, resource.RLIMIT_FSIZE):
        resource.setrlimit(limit, (most_bytes, most_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def answer_task(request: Request, task: Task) -> bytes:
    """`ANSWER` with what was asked for, or `REFUSAL` with reason, detail and kind as JSON. Raises MemoryError alone."""
    try:
        return ANSWER + _answer(request, task)
    except MeshError as error:
        refusal = error
    except MemoryError:
        raise
    except Exception as error:  # whatever a stranger's bytes made a library raise, it is they that are refused
        if isinstance(error, OSError) and error.errno in (errno.ENOMEM, errno.EFBIG):
            raise MemoryError from error
        refusal = MeshError("unreadable", f"{task.path} cannot be read: {describe_error(error)}")
    detail = refusal.detail if task.path.name in refusal.detail else f"{task.path}: {refusal.detail}"
    return REFUSAL + json.dumps([refusal.reason, one_line(detail), refusal.kind]).encode()


def _answer(request: Request, task: Task) -> bytes:
    if task.kind == "list":
        paths = list_files(request.settings, request.folder, task.path, request.assets.limits)
        files = hash_files(paths, request.folder)
        return json.dumps([[file.path, file.size, file.sha256] for file in files]).encode()
    if task.kind == "names":
        found = list_named(task.path, request.folder, request.assets.limits)
        return json.dumps([path.relative_to(request.folder).as_posix() for path in found]).encode()
    assert task.entry is not None
    asset = load_entry(request.settings, request.folder, task.entry, task.category, request.assets)
    if task.kind == "load":
        return pack_asset(asset)
    hull = _check_fit(asset, task.path)
    if task.kind == "measure":
        return measure_asset(asset, hull, task.path).encode()
    doubt = None if hull is None else find_doubt(asset, request.settings, hull.vertices)
    return (doubt or "").encode()


def _check_fit(asset: Asset, path: Path) -> Hull | None:
    """The convex hull, which is what an object collides and is placed by; None for a table. MeshError `no_hull` or `no_size`."""
    if asset.category == TABLE:
        return None
    try:
        hull = convex_hull(asset.shape.vertices)
    except (QhullError, ValueError) as error:
        raise MeshError("no_hull", f"{path} is no body: it needs four points apart that are not in a line") from error
    if measure_thinness(asset.shape.vertices) < THINNEST:
        more = "it would lie unseen in the table's top: give it a thickness, such as by Blender's Solidify"
        raise MeshError("no_size", f"{path} is flat, without thickness: {more}")
    return hull


_PLAIN = (
    *("instance_id", "category", "source", "licence", "path", "sha256"),
    *("scale", "watertight", "volume_m3", "shareable"),
)
"""Fields of an asset that JSON holds as they are."""
_ARRAYS = ("vertices", "faces", "normals", "uv", "colors")
"""Arrays of a part."""


def pack_asset(asset: Asset) -> bytes:
    """The asset as the length of a JSON text, the text, and its arrays.

    An array comes back bit by bit and in its memory order, on which the last bits of sums depend; one that parts share is
    written once and shared again. Built-in shapes have fields that files have not, and are not packed.
    """
    arrays: dict[int, NDArray] = {}

    def number(array: NDArray | bytes | None) -> int | None:
        if array is None:
            return None
        arrays.setdefault(id(array), np.frombuffer(array, np.uint8) if isinstance(array, bytes) else array)
        return list(arrays).index(id(array))

    parts = [
        {name: number(getattr(part, name)) for name in _ARRAYS}
        | {"name": part.name, "color": part.material.base_color, "texture": number(part.material.texture)}
        | {"metallic": part.material.metallic, "roughness": part.material.roughness}
        | {"jpeg": number(part.material.jpeg)}
        for part in asset.shape.parts
    ]
    mass = asset.mass
    tree = {name: getattr(asset, name) for name in _PLAIN} | {
        "notes": asset.notes,
        "parts": parts,
        "closed": asset.shape.closed,
        "mass": [mass.mass_kg, mass.com.tolist(), mass.inertia.tolist(), mass.solid],
        "T_source_to_object": asset.T_source_to_object.tolist(),
        "arrays": len(arrays),
    }
    text, stream = json.dumps(tree).encode(), io.BytesIO()
    stream.write(len(text).to_bytes(8, "little") + text)
    for array in arrays.values():
        np.lib.format.write_array(stream, array, allow_pickle=False)
    return stream.getvalue()


def unpack_asset(data: bytes) -> Asset:
    """The asset of `pack_asset`. MeshError `unreadable` where the bytes are not such, or the arrays do not fit."""
    try:
        stream = io.BytesIO(data)
        tree = json.loads(stream.read(int.from_bytes(stream.read(8), "little")))
        arrays = [np.lib.format.read_array(stream, allow_pickle=False) for _ in range(tree["arrays"])]
        for array in arrays:
            array.setflags(write=False)
        jpegs = {k: arrays[k].tobytes() for k in {part["jpeg"] for part in tree["parts"]} - {None}}
        mass_kg, com, inertia, solid = tree["mass"]
        return Asset(
            **{name: tree[name] for name in _PLAIN},
            shape=Shape(tuple(_part(part, arrays, jpegs) for part in tree["parts"]), tree["closed"]),
            mass=MassProperties(mass_kg, frozen_array(com), frozen_array(inertia), solid),
            T_source_to_object=frozen_array(tree["T_source_to_object"]),
            notes=tuple(tree["notes"]),
        )
    except (ValueError, LookupError, TypeError, EOFError, MemoryError, OverflowError) as error:
        raise MeshError("unreadable", f"the mesh reader's answer makes no sense: {error!r:.200}") from error


def _part(tree: dict[str, Any], arrays: list[NDArray], jpegs: dict[int, bytes]) -> Part:
    given = {name: None if tree[name] is None else arrays[tree[name]] for name in (*_ARRAYS, "texture")}
    vertices, faces, texture = given["vertices"], given["faces"], given.pop("texture")
    if vertices is None or faces is None:
        raise ValueError("a part without a mesh")
    count = len(vertices)
    kinds = (np.float64, np.int32, np.float64, np.float64, np.uint8)
    shapes = (count, 3), (len(faces), 3), (count, 3), (count, 2), (count, 4)
    for (name, array), kind, shape in zip(given.items(), kinds, shapes, strict=True):
        if array is None:
            continue
        if array.dtype != kind or array.shape != shape or (kind is np.float64 and not np.isfinite(array).all()):
            raise ValueError(f"{name} {array.shape} of {array.dtype}")
    if texture is not None and (texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] not in (3, 4)):
        raise ValueError(f"a texture {texture.shape} of {texture.dtype}")
    if not len(faces) or int(faces.min()) < 0 or int(faces.max()) >= count:
        raise ValueError("a face names a vertex that is not there")
    red, green, blue, alpha = (float(value) for value in tree["color"])
    material = Material(
        base_color=(red, green, blue, alpha),
        metallic=float(tree["metallic"]),
        roughness=float(tree["roughness"]),
        texture=texture,
        jpeg=jpegs.get(tree["jpeg"]),
    )
    return Part(str(tree["name"]), vertices, faces, material, given["normals"], given["uv"], given["colors"])
