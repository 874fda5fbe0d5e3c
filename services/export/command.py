"""`verso export`: writes a dataset in another layout, and says what was left out."""

import argparse
import json
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from schemas.errors import OutputError
from services.export.choice import Choice
from services.export.request import ExportRequest
from services.export.step import LEFT_OUT, ExportResult, export
from services.job.record import require_dataset
from services.read.damage import explain_damage
from services.run.progress import ProgressLine
from workers.store.store import open_store


def main(options: argparse.Namespace) -> int:
    """Export what the options ask for; returns 0, or 1 where no pair could be exported."""
    if "://" in options.dir:
        raise OutputError(f"{options.dir} is not a folder: export into one on this machine, and copy it there")
    store = require_dataset(open_store(options.out))
    first, last = options.scenes or (None, None)
    choice = Choice(categories=tuple(options.category), first_scene=first, last_scene=last, where=options.where)
    request = ExportRequest(store, Path(options.dir), options.format, choice, options.shard_mb)
    begun = time.monotonic()
    with explain_damage(store), closing(ProgressLine(0, "export")) as line:

        def report(done: int, asked: int) -> None:
            line.expect(asked)
            line.show(done)

        result = export(request, report)
    _tell(options, result, time.monotonic() - begun)
    return 0 if result.manifest["pairs"] else 1


def _tell(options: argparse.Namespace, result: ExportResult, seconds: float) -> None:
    """Prints what the export holds and what it leaves out."""
    manifest = result.manifest
    now = f" ({result.pairs_now} now, in {seconds:.1f} s)" if result.pairs_now else " (nothing was left to do)"
    print(f"{options.dir}: {options.format}, {manifest['pairs']} pairs of {manifest['scenes']} scenes{now}")
    for reason, count in manifest["left_out"].items():
        print(f"  left out: {count} pairs, {reason}")
    if manifest["pairs_left_out"]:
        print(f"  {Path(options.dir) / LEFT_OUT} names each of them")
    for line in manifest.get("not_exported", ()):
        print(f"  not exported: {line}")
    if not manifest["pairs"]:
        told = "no scene was chosen" if not manifest["pairs_left_out"] else "every pair was left out"
        print(f"verso: {options.dir} holds no pair: {told}", file=sys.stderr)
    if options.json:
        answer: dict[str, Any] = {
            "ok": manifest["pairs"] > 0,
            "dir": options.dir,
            "pairs_now": result.pairs_now,
            **manifest,
        }
        print(json.dumps(answer))
