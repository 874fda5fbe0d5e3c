"""`verso capture import`: an Azure Kinect recording as a capture folder."""

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from schemas.errors import InputError, OutputError
from schemas.job.captures import Board

if TYPE_CHECKING:
    from workers.store.capture_folder import CaptureFile


def import_recording(options: argparse.Namespace) -> int:
    """Reads options.recording, `out`, `frames`, `board` (a path or None), `name`, `category` and `json`. Returns 0.

    Raises InputError and OutputError for what cannot be, CaptureError for a recording that cannot be used.
    """
    from workers.capture.recording.pairs import describe_losses
    from workers.pipeline.captures import import_recording as work
    from workers.store.capture_folder import read_board

    recording, out = Path(options.recording), Path(options.out)
    about = _describe(options.name, options.category, out)
    board = read_board(Path(options.board)) if options.board else Board()
    if not recording.is_file():
        raise InputError(f"{recording}: no such file")
    made = work.import_recording(recording, _make_empty(out), about, board, options.frames)
    notes = describe_losses(made.losses)
    print(
        f"{out}: {len(made.views)} views of {made.frames} frames, depth registered by the recording's own calibration"
    )
    print("\n".join(f"  {note}" for note in notes), end="\n" if notes else "")
    if not options.board:
        print(f"  no --board: board.json is the default board ({board.columns} x {board.rows}, {board.dictionary})")
    if options.json:
        told = {"ok": True, "out": str(out), "frames": made.frames, "notes": notes, "default_board": not options.board}
        print(json.dumps({**told, "losses": asdict(made.losses), "views": [asdict(view) for view in made.views]}))
    return 0


def _describe(name: str | None, category: str, out: Path) -> "CaptureFile":
    from workers.store.capture_folder import CaptureFile, derive_name

    try:
        return CaptureFile(name=name or derive_name(out.resolve().name), category=category)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(
            f"--{first['loc'][0]} {first['input']!r}: letters, digits, - and _ only, at most 64"
        ) from error


def _make_empty(out: Path) -> Path:
    """The folder, made if need be. Raises OutputError where it holds something or cannot be made."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise OutputError(f"{out} is not empty: name a new folder, or remove it")
    except OSError as error:
        raise OutputError(f"{out} cannot be made: {error.strerror}") from error
    return out
