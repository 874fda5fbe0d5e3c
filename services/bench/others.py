"""The other systems that make the same scenes, each in a process of its own. A new one is a module and a row in `SIDES`.

Such a module says `{"ready": true}`, then reads one line of JSON for each scene (`scene`: the `scene.json` that handover.py
wrote beside its meshes; `out`: a folder; and the items of `asked` in its row) and answers with one line: `wall_s`, `cpu_s`,
`stages_s` by stage, and `load_s`, the seconds of reading files before its clock. `answer_scenes` in answers.py does that.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any

from schemas.environment import FOR_SPEED
from schemas.errors import MachineError
from schemas.job.job import Job
from services.bench.ratios import Lap


@dataclass(frozen=True)
class Side:
    """One other system: its name in JSON and in the text, what it makes, its module, and the package that it needs."""

    name: str
    title: str
    makes: str
    module: str
    asked: Mapping[str, str] = field(default_factory=dict)
    package: str | None = None
    only_raster: bool = False
    """Whether its images are comparable with those of the raster tier only."""


SIDES = (
    Side(
        "script_plain",
        "the script, plain look",
        "same files; RGB with a floor of one colour, one light, no shadows",
        "services.bench.baseline",
        {"look": "plain"},
    ),
    Side(
        "script_same_look",
        "the script, same look",
        "same files; RGB with the floor's texture, the scene's lights and pyrender's shadows",
        "services.bench.baseline",
        {"look": "same"},
        only_raster=True,
    ),
    Side(
        "mujoco",
        "MuJoCo",
        "physics and 3 views in memory; no textures, no projection, no patches, no files",
        "services.bench.mujoco_side",
        package="mujoco",
    ),
)

ELSEWHERE = {"Blender Cycles": "bpy"}
"""Systems without a row here, and the package of each."""


def sides_of(job: Job) -> list[Side]:
    """The systems that can make a job's scenes on this machine."""
    comparable = [side for side in SIDES if job.render.tier == "raster" or not side.only_raster]
    return [side for side in comparable if side.package is None or installed(side.package)]


def other_systems() -> dict[str, str]:
    """Versions of the optional systems by name, `not installed` for those that are not. Imports nothing."""
    packages = {side.title: side.package for side in SIDES if side.package is not None} | ELSEWHERE
    return {title: installed(package) or "not installed" for title, package in packages.items()}


def installed(package: str) -> str | None:
    """Version of a package, None where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


class SideProcess:
    """A running script. It inherits our core and our environment, and never shares our OpenGL context.

    Only what is set for our own speed (`FOR_SPEED`) it does not inherit: few people who write such scripts set it.
    """

    def __init__(self, name: str, process: subprocess.Popen[str], errors: IO[str]) -> None:
        self._name, self._process, self._errors = name, process, errors
        self.greeting = self.ask()
        """The first answer, given before any question."""

    def run(self, scenes: Sequence[Path], out: Path, asked: Mapping[str, str]) -> Lap:
        """Makes these scenes, one after another, into one folder."""
        answers = [self.ask({"scene": str(scene), "out": str(out), **asked}) for scene in scenes]
        wall, cpu, load = (sum(answer[key] for answer in answers) for key in ("wall_s", "cpu_s", "load_s"))
        names = dict.fromkeys(name for answer in answers for name in answer["stages_s"])
        stages = {name: sum(answer["stages_s"].get(name, 0.0) for answer in answers) for name in names}
        return Lap(len(scenes), wall, cpu, stages, load)

    def ask(self, question: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """The next answer. Raises MachineError with the process's last lines where it died."""
        assert self._process.stdin is not None and self._process.stdout is not None
        line = ""
        with contextlib.suppress(BrokenPipeError):
            if question is not None:
                print(json.dumps(question), file=self._process.stdin, flush=True)
            line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            self._errors.seek(0)
            last = " | ".join(self._errors.read().strip().splitlines()[-5:])
            raise MachineError(f"{self._name} ended ({self._process.returncode}): {last}")
        answer: dict[str, Any] = json.loads(line)
        return answer


@contextlib.contextmanager
def start_side(name: str, command: Sequence[str] | None = None) -> Iterator[SideProcess]:
    """A process after its first answer: the command, or without one our module `name`. Raises MachineError."""
    command, pipe = command or [sys.executable, "-W", "ignore", "-m", name], subprocess.PIPE
    root = Path(__file__).resolve().parents[2]
    with tempfile.TemporaryFile("w+") as errors:
        try:
            process = subprocess.Popen(
                command, cwd=root, env=_plain_environment(), stdin=pipe, stdout=pipe, stderr=errors, text=True
            )
        except OSError as error:
            raise MachineError(f"{command[0]} cannot be run: {error}") from error
        try:
            yield SideProcess(name, process, errors)
        finally:
            process.kill()
            process.communicate()


def _plain_environment() -> dict[str, str]:
    """This process's environment without what is set for our own speed."""
    inherited = os.environ  # noqa: TID251 - a child's environment is all of it
    return {name: value for name, value in inherited.items() if FOR_SPEED.get(name) != value}
