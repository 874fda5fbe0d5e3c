"""Another system in a process of its own: one line of JSON to it for each scene, one line back."""

import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from schemas.errors import MachineError
from services.bench.ratios import Lap

ROOT = Path(__file__).resolve().parents[2]


class SideProcess:
    """A running script. It inherits our core and our environment, and never shares our OpenGL context."""

    def __init__(self, name: str, process: subprocess.Popen[str], errors: IO[str]) -> None:
        self._name, self._process, self._errors = name, process, errors
        self.greeting = self.ask()
        """The first answer, given before any question."""

    def run(self, scenes: Sequence[Path], out: Path, asked: Mapping[str, str]) -> Lap:
        """Makes these scenes, one after another, into one folder."""
        wall, cpu, load = 0.0, 0.0, 0.0
        stages: dict[str, float] = {}
        for scene in scenes:
            answer = self.ask({"scene": str(scene), "out": str(out), **asked})
            wall, cpu, load = wall + answer["wall_s"], cpu + answer["cpu_s"], load + answer["load_s"]
            for stage, seconds in answer["stages_s"].items():
                stages[stage] = stages.get(stage, 0.0) + seconds
        return Lap(len(scenes), wall, cpu, stages, load)

    def ask(self, question: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """The next answer. Raises MachineError with the process's last lines where it died."""
        assert self._process.stdin is not None and self._process.stdout is not None
        line = ""
        with contextlib.suppress(BrokenPipeError):
            if question is not None:
                self._process.stdin.write(json.dumps(question) + "\n")
                self._process.stdin.flush()
            line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            self._errors.seek(0)
            last = " | ".join(self._errors.read().strip().splitlines()[-5:])
            raise MachineError(f"{self._name} ended ({self._process.returncode}): {last}")
        answer: dict[str, Any] = json.loads(line)
        return answer


@contextlib.contextmanager
def side_process(module: str) -> Iterator[tuple[SideProcess, float]]:
    """One of our modules as a process, ready for its first scene, and the seconds that took. Raises MachineError."""
    begun = time.perf_counter()
    with start_side([sys.executable, "-W", "ignore", "-m", module], module) as side:
        yield side, time.perf_counter() - begun


@contextlib.contextmanager
def start_side(command: Sequence[str], name: str) -> Iterator[SideProcess]:
    """The command as a process, after its first answer; `name` stands in messages. Raises MachineError."""
    pipe = subprocess.PIPE
    with tempfile.TemporaryFile("w+") as errors:
        try:
            process = subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=errors, text=True)
        except OSError as error:
            raise MachineError(f"{command[0]} cannot be run: {error}") from error
        try:
            yield SideProcess(name, process, errors)
        finally:
            process.kill()
            process.communicate()
