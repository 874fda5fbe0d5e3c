"""`verso capture board`: the marker board as a file to print."""

import argparse
import json
from pathlib import Path

from schemas.errors import InputError, OutputError
from schemas.job.captures import Board


def board(options: argparse.Namespace) -> int:
    """Writes options.file (.pdf or .png); reads `board`, `tiles` (None or "a4"), `dpi` and `json`. Returns 0."""
    from workers.capture.board.picture import board_png
    from workers.capture.board.sheets import board_pdf, tiled_pdf
    from workers.store.capture_folder import read_board

    path = Path(options.file)
    spec = read_board(options.board) if options.board else Board()
    kind = path.suffix.lower()
    if kind == ".pdf":
        data = tiled_pdf(spec) if options.tiles else board_pdf(spec)
    elif kind == ".png":
        if options.tiles:
            raise InputError("--tiles makes pages, and a PNG has none: name a file that ends in .pdf")
        data = board_png(spec, options.dpi)
    else:
        raise InputError(f"{path}: name a file that ends in .pdf or .png")
    try:
        path.write_bytes(data)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}") from error
    told = "A4 pages to glue" if options.tiles else "print at 100 %"
    print(f"{path}: {spec.columns} x {spec.rows} markers of {spec.marker_m * 1000:g} mm ({spec.dictionary}); {told}")
    print(
        f"measure the printed ruler; if it is not {spec.ruler_m * 1000:g} mm, say so in board.json (measured_ruler_m)"
    )
    if options.json:
        print(json.dumps({"ok": True, "file": str(path), "board": spec.model_dump(mode="json")}))
    return 0
