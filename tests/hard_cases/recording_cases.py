"""The table of hard cases for recordings: what is made of them, or why they are refused.

Every recording shows a marker board with a sphere on it, whose depth is known exactly.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from schemas.job.captures import Board
from tests.hard_cases.camera_cases import HOLD
from tests.hard_cases.case import refuse
from tests.workers.door.recordings import (
    PERIOD_US,
    START_US,
    TAGS,
    Track,
    calibration,
    poses,
    recording,
    renamed,
    tracks,
    true_depth,
    without,
    write_recording,
)
from workers.capture.folder import CaptureFile, open_folder, read_view
from workers.capture.import_recording import Imported, import_recording

COUNT = 6
DEPTH_MM = 1.3
"""Millimetres of the recording and of the folder, each rounded, on a steep table."""

Make = Callable[[], bytes]
Check = Callable[[Imported], None]


@dataclass(frozen=True, eq=False)
class RecordingCase:
    """One row: the file's bytes, what must become of it, and what must be told of losses."""

    name: str
    outcome: str
    make: Make
    told: Check = lambda made: None


def worst_table_mm(case: RecordingCase, folder: Path) -> float:
    """Largest error of depth on the table, over all views, mm; the sphere with its surroundings left out. Checks what is told."""
    (folder / "recording.mkv").write_bytes(case.make())
    out, worst = folder / "capture", 0.0
    out.mkdir()
    made = import_recording(folder / "recording.mkv", out, CaptureFile(name="case"), Board(), 40)
    case.told(made)
    for view in made.views:
        frame = round((view.color_us - START_US) / PERIOD_US)
        depth = read_view(open_folder(out), view.number).depth
        assert depth is not None and (depth > 0).mean() > 0.5
        true, _ = true_depth("color", poses(COUNT)[frame])
        table = depth > 0
        table[240:480, 520:760] = False
        worst = max(worst, float(np.abs(depth - true * 1000)[table].max()))
    return worst


def file(made: list[Track], attached: bytes | None = json.dumps(calibration()).encode(), **settings: Any) -> bytes:
    return write_recording(made, attached, TAGS, **settings)


def losing(name: str, *frames: int) -> Make:
    """A recording whose track lacks some frames."""

    def make() -> bytes:
        kept = {t.name: [f for i, f in enumerate(t.frames) if i not in frames] for t in tracks(COUNT)}
        return file(renamed(tracks(COUNT), name, frames=kept[name]))

    return make


def damaged() -> bytes:
    """The second colour frame has lost its second half, and the third is no image at all."""
    color = list(tracks(COUNT)[0].frames)
    color[1] = (color[1][0], color[1][1][: len(color[1][1]) // 2])
    color[2] = (color[2][0], b"\xff\xd8" + bytes(1000) + b"\xff\xd9")
    return file(renamed(tracks(COUNT), "COLOR", frames=color))


def cut(share: float) -> Make:
    return lambda: (data := recording(COUNT))[: int(len(data) * share)]


def unclosed() -> bytes:
    """The recorder was killed: the file's size and length were never filled in, and the last frame is half there."""
    data = recording(COUNT, closed=False)
    at = data.index(b"\x18\x53\x80\x67") + 4
    return (data[:at] + b"\x01" + b"\xff" * 7 + data[at + 8 :])[: int(len(data) * 0.8)]


def losses(views: int, **numbers: int | None) -> Check:
    def check(made: Imported) -> None:
        found = {name: getattr(made.losses, name) for name in numbers}
        assert (len(made.views), found) == (views, numbers)

    return check


def other_calibration(text: str) -> Make:
    return lambda: file(tracks(1), text.encode())


RECORDINGS = (
    RecordingCase("whole", HOLD, lambda: recording(COUNT), losses(6, cut=0, dropped=0, damaged=0)),
    RecordingCase("cut", HOLD, cut(0.6), losses(4, cut=2)),
    RecordingCase("never closed", HOLD, unclosed, losses(5, cut=None)),
    RecordingCase("two colour frames dropped", HOLD, losing("COLOR", 2, 3), losses(4, dropped=2, without_depth=0)),
    RecordingCase("two depth frames dropped", HOLD, losing("DEPTH", 0, 4), losses(4, dropped=0, without_depth=2)),
    RecordingCase("two damaged colour frames", HOLD, damaged, losses(4, damaged=2, dropped=0)),
    RecordingCase("cut before the first frame", refuse("empty"), cut(0.02)),
    RecordingCase("zero length", refuse("empty"), lambda: b""),
    RecordingCase("another kind of file", refuse("unreadable"), lambda: b"RIFF" * 500),
    RecordingCase("cut inside its head", refuse("unreadable"), lambda: recording(1)[:200]),
    RecordingCase("without calibration", refuse("calibration"), lambda: file(tracks(1), None)),
    RecordingCase("calibration of another camera", refuse("calibration"), other_calibration('{"fx": 600}')),
    RecordingCase("calibration cut short", refuse("calibration"), other_calibration('{"Calibration')),
    RecordingCase("depth only", refuse("color"), lambda: file(without(tracks(1), "COLOR"))),
    RecordingCase("colour only", refuse("depth"), lambda: file(without(tracks(1), "DEPTH"))),
    RecordingCase("no depth frame", refuse("empty"), losing("DEPTH", *range(COUNT))),
    RecordingCase(
        "unknown depth mode",
        refuse("mode"),
        lambda: file(renamed(tracks(1), "DEPTH", tags={"K4A_DEPTH_MODE": "NFOV_4X4BINNED"})),
    ),
)
