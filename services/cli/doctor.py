"""`verso doctor`: what this machine has, what is missing, and the fingerprint of its stack."""

import argparse
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from schemas.errors import MachineError, VersoError
from services.run.machine import usable_cores
from services.run.progress import finish


@dataclass(frozen=True)
class Finding:
    """One line of the answer: what was examined, whether it suffices, what was found, and the remedy where it does not."""

    what: str
    ok: bool
    found: str
    remedy: str = ""


def main(options: argparse.Namespace) -> int:
    """Examine everything and print it; returns 1 where something is missing."""
    findings = [*examine_machine(), _ray(), _gpus(), _renderer(), _stack()]
    width = max(len(finding.what) for finding in findings)
    for finding in findings:
        print(f"{'ok     ' if finding.ok else 'MISSING'}  {finding.what:{width}}  {finding.found}")
        if not finding.ok:
            print(f"         {'':{width}}  -> {finding.remedy}")
    ok = all(finding.ok for finding in findings)
    return finish(options, ok, findings=[asdict(finding) for finding in findings])


def examine_machine() -> Iterator[Finding]:
    """Python, cores, memory and disks."""
    ok = (3, 11) <= sys.version_info[:2] <= (3, 13) and platform.machine() == "x86_64"
    python = f"CPython {platform.python_version()} on {platform.machine()}, glibc {platform.libc_ver()[1] or 'unknown'}"
    yield Finding("python", ok, python, "use CPython 3.11 to 3.13 on x86-64, or docker compose")
    yield Finding("cores", True, f"{usable_cores()} usable of {os.cpu_count()}: the default for --workers")
    available = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    remedy = "a worker takes up to 0.7 GiB: free some"
    yield Finding("memory", available > 2**30, f"{available / 2**30:.1f} GiB free", remedy)
    free = shutil.disk_usage(Path.cwd()).free
    # A scene with one pair takes about 3.5 MB.
    room = f"{free / 2**30:.0f} GiB free here, room for about {free // 3_500_000:,} scenes"
    yield Finding("disk", free > 2**30, room, "free some")
    free = shutil.disk_usage("/dev/shm").free if Path("/dev/shm").exists() else 0
    # Ray's object store wants 200 MiB.
    yield Finding("/dev/shm", free > 200 * 2**20, f"{free / 2**20:.0f} MiB free", "docker run --shm-size=1g")


def _ray() -> Finding:
    try:
        return Finding("ray", True, f"{version('ray')}, temporary files in {tempfile.gettempdir()}")
    except PackageNotFoundError:
        return Finding("ray", False, "not installed", "run ./verso once: it installs what the lock file names")


def _gpus() -> Finding:
    """EGL's devices, and which of them this process takes."""
    try:
        from workers.render.raster.context import choose, describe, list_devices, visible_gpus

        devices, choice = list_devices(), choose()
    except MachineError as error:
        return Finding("GPUs", False, "none that may be drawn on", str(error))
    except (ImportError, AttributeError, TypeError):  # what a missing library shows as
        devices = ()
    if not devices:
        return Finding("GPUs", True, "EGL lists none")
    visible = visible_gpus()
    why = choice.reason or ("the first" if visible is None else f"CUDA_VISIBLE_DEVICES is {visible!r}")
    listed = "; ".join(describe(device) for device in devices)
    return Finding("GPUs", True, f"{listed}: drawn on device {choice.index} ({why})")


def _renderer() -> Finding:
    try:
        from workers.render.raster.context import is_software
        from workers.render.raster.gbuffer import shared_renderer

        name = shared_renderer().name
    except MachineError as error:
        return Finding("GL", False, "no off-screen OpenGL", str(error))
    kind = "software, on the CPU" if is_software(name) else "hardware"
    return Finding("GL", True, f"{name} ({kind})")


def _stack() -> Finding:
    try:
        from workers.render.raster.gbuffer import shared_renderer
        from workers.shard.fingerprint import take_fingerprint

        stack = take_fingerprint(shared_renderer(), "raster")
    except VersoError as error:
        return Finding("fingerprint", False, "the canary scene could not be made", str(error))
    fingerprint = f"{stack.digest[:16]} (canary {stack.canary[:16]}, numpy up to {stack.simd.split()[-1]})"
    return Finding("fingerprint", True, fingerprint)
