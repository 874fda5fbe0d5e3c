"""The tree of errors that the project raises.

    VersoError
    +-- InputError          the command line, the job file or an asset folder is wrong        exit 2
    |   +-- JobError        a key of the job file: names the file, the key, the value
    |   +-- AssetSourceError  a folder of assets that cannot be used at all
    |   +-- OutputError     the output folder belongs to another job, or cannot be written
    +-- RunError            it ran, but something is missing or wrong                         exit 1
    |   +-- InUseError      another run works in the output folder
    |   +-- MachineError    this machine lacks something (GL, disk, a Ray that answers)
    |   +-- CommitConflict  two attempts at one range made different bytes
    |   +-- CorruptError    a stored file does not match its checksum or cannot be read
    |   +-- FingerprintError  a worker's stack makes other bytes than the dataset's
    +-- SceneError          this scene cannot be made: a row in `failures`, never a crash
        +-- MeshError       a mesh from outside was refused at the door
        +-- StartError      no valid start state
        +-- SettleError     the object did not come to rest on the table
        +-- ViewError       a camera does not see what it must
        +-- LabelError      a check found labels that disagree
        +-- CaptureError    a capture that cannot be read, or whose poses cannot be estimated

A message says what failed, the number measured, and the setting to change. All arguments go to `Exception.__init__`,
because an exception that crosses processes is rebuilt from them.
"""

import difflib
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Literal

FailureKind = Literal["intrinsic", "environmental"]


class VersoError(Exception):
    """The root: a failure with a clear message for the user."""

    exit_code = 1


class InputError(VersoError):
    """Wrong input; nothing was started."""

    exit_code = 2


class JobError(InputError):
    """A job file that cannot be used; the message names the file, the key, the value and what is allowed."""


class AssetSourceError(InputError):
    """An asset source with nothing usable in it."""


class OutputError(InputError):
    """An output folder that belongs to another job or cannot be written."""


class RunError(VersoError):
    """The work ran, and something is missing or wrong."""


class InUseError(RunError):
    """Another process works in the folder: `place` and `by` say which."""

    def __init__(self, message: str, place: str = "", by: str = "") -> None:
        super().__init__(message, place, by)
        self.place = place
        self.by = by

    def __str__(self) -> str:
        return str(self.args[0])


class MachineError(RunError):
    """This machine lacks something that the work needs; the message says how to get it."""


class CommitConflict(RunError):
    """Two attempts at one range made different bytes."""


class CorruptError(RunError):
    """A stored file that cannot be read or does not match its checksum."""


class FingerprintError(RunError):
    """A worker whose stack makes other bytes than the dataset's."""


class SceneError(VersoError):
    """A scene that cannot be made: a row in `failures`; `reason` is a short stable word, `detail` a sentence."""

    stage = "scene"
    kind: FailureKind = "intrinsic"

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(reason, detail)
        self.reason = reason
        self.detail = detail

    def __str__(self) -> str:
        return f"{self.stage}: {self.reason}: {self.detail}"


class MeshError(SceneError):
    """A mesh from outside that was refused at the door."""

    stage = "assets"


class StartError(SceneError):
    """No valid start state."""

    stage = "plan"


class SettleError(SceneError):
    """The object did not come to rest on the table."""

    stage = "settle"


class ViewError(SceneError):
    """A camera that does not see what it must."""

    stage = "views"


class LabelError(SceneError):
    """A check found labels that disagree."""

    stage = "check"


class CaptureError(SceneError):
    """A capture that cannot be read, or whose poses cannot be estimated."""

    stage = "capture"


def plain_line(text: str, most: int = 80) -> str:
    """`text` with at most `most` characters of it, and an escape in place of what is not printable."""
    cut = text if len(text) <= most else f"{text[: most - 3]}..."
    return cut if cut.isprintable() else "".join(map(_printable, cut))


def _printable(character: str) -> str:
    return character if character.isprintable() else character.encode("unicode_escape").decode()


@contextmanager
def needs_making(what: str) -> Iterator[None]:
    """Around imports of what makes data, in what reads it. Raises MachineError where verso-read alone is installed."""
    try:
        yield
    except ModuleNotFoundError as error:
        if not {"schemas", "services", "workers"} & set((error.name or "").split(".")[:2]):
            raise
        raise MachineError(
            f"{what} needs what makes data, which this installation does not have: "
            "install verso-data in place of verso-read (Linux on x86-64)"
        ) from error


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A question with the nearest of the known words and a space behind it; empty where none is near."""
    near = difflib.get_close_matches(word, known, n=1)
    return f"did you mean '{near[0]}'? " if near else ""


def command_line(*words: object) -> str:
    """A command of ours as a shell takes it, whatever its words hold."""
    return shlex.join(["verso", *map(str, words)])


_SPANS = ((60.0, 1.0, "s"), (5400.0, 60.0, "min"), (48 * 3600.0, 3600.0, "h"), (float("inf"), 86400.0, "d"))
"""(below so many seconds, seconds in one, its symbol)."""


def describe_seconds(seconds: float) -> str:
    """Seconds in one unit, with two digits or whole: "0.12 s", "8 s", "2.5 min", "31 h", "9 d"."""
    _, second, name = next(span for span in _SPANS if seconds < span[0])
    value = seconds / second
    return f"{float(f'{value:.2g}') if value < 100.0 else round(value):g} {name}"


def plural(count: int, noun: str) -> str:
    """A number with its noun: "1 scene", "1,200 scenes", "2 meshes", "2 categories"."""
    ends = ("y", "ies") if noun.endswith("y") else ("", "es") if noun.endswith("sh") else ("", "s")
    return f"{count:,} {noun if count == 1 else noun.removesuffix(ends[0]) + ends[1]}"


def number(value: float) -> str:
    """Three digits: "0", "0.00012", "13.4", "1,250"; below a ten-thousandth and from a million on "3.5e-5"."""
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        digits, _, exponent = f"{value:.3g}".partition("e")
        return f"{digits}e{int(exponent)}" if exponent else digits
    return f"{float(f'{value:.3g}'):,.8f}".rstrip("0").rstrip(".")


def milliseconds(ms: float) -> str:
    """The time of a scene: "118 ms", "11.2 s"."""
    return f"{number(ms)} ms" if ms < 9999.5 else f"{number(ms / 1e3)} s"


_SIZES = ((1e3, 1.0, "kB"), (1e6, 1e3, "MB"), (1e9, 1e6, "GB"), (float("inf"), 1e9, "TB"))


def size(kilobytes: float) -> str:
    """The size of a job's files: "15 MB"."""
    value, name = next((kilobytes / unit, name) for most, unit, name in _SIZES if kilobytes < most)
    return f"{number(float(f'{value:.2g}') if value < 100.0 else round(value))} {name}"
