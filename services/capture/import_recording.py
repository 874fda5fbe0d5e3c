"""`verso capture import`: an Azure Kinect recording as a capture folder."""

import argparse
import json
import re
from dataclasses import asdict
from pathlib import Path

from schemas.errors import InputError, OutputError
from schemas.job.captures import Board


def import_recording(options: argparse.Namespace) -> int:
    """Reads options.recording, `out`, `views`, `board` (a path or None), `category` and `json`. Returns 0."""
    from workers.capture.recording.pairs import describe_losses
    from workers.pipeline.captures import import_recording as work
    from workers.store.capture_folder import CaptureFile, read_board

    recording, out = Path(options.recording), Path(options.out)
    board = read_board(Path(options.board)) if options.board else Board()
    if not recording.is_file():
        raise InputError(f"{recording}: no such file")
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", recording.stem).lstrip("._-")[:64] or "recording"
    about = CaptureFile(name=name, category=options.category)
    made = work.import_recording(recording, _make_empty(out), about, board, options.views)
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


def _make_empty(out: Path) -> Path:
    """The folder, made if need be. Raises OutputError where it holds something or cannot be made."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise OutputError(f"{out} is not empty: name a new folder, or remove it")
    except OSError as error:
        raise OutputError(f"{out} cannot be made: {error.strerror}") from error
    return out
