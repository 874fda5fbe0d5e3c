"""Handlers of the commands that show a dataset to people."""

import argparse
import sys
import time
from pathlib import Path

from services.cli.commands import answer_json


def report(options: argparse.Namespace) -> int:
    """`verso report`."""
    from services.read.damage import explain_damage
    from services.report.report import write_report
    from workers.store.store import open_store

    began = time.monotonic()
    store = open_store(options.out)
    target = options.file or default_page(options.out)
    beside = None if options.beside is None else open_store(options.beside)
    with explain_damage(store):
        size, made = write_report(store, options.scenes, target, beside)
    seconds = time.monotonic() - began
    print(f"{target}: {made.figures.scenes} scenes, pictures of {len(made.sample.scenes)}, {size / 1e6:.1f} MB")
    answer = {"file": str(target), "bytes": size, "seconds": round(seconds, 2), "scenes": made.figures.scenes}
    answer_json(options, {"ok": True, **answer, "shown": [one.scene_id for one in made.sample.scenes]})
    return 0


def serve(options: argparse.Namespace) -> int:
    """`verso serve`."""
    from services.report.follow import Follower
    from services.report.server import choose_place, ended_by_signal, serving
    from workers.store.store import open_store

    place = choose_place(options.host, options.port, options.token)
    follower = Follower(open_store(options.out), options.scenes)
    with ended_by_signal() as ended, serving(follower, place) as opened:
        print(f"{options.out}: {opened.address} (Ctrl-C ends it)", flush=True)
        answer_json(options, {"ok": True, "address": opened.address, "port": opened.port, "token": opened.token})
        sys.stdout.flush()
        follower.start()
        try:
            ended.wait()
        finally:
            follower.stop()
    return 0


def default_page(out: str) -> Path:
    """The page of a dataset: beside its folder, or here for a bucket's."""
    name = out.rstrip("/").rpartition("/")[2] or "dataset"
    return Path(f"{name}-report.html") if "://" in out else Path(out).resolve().with_name(f"{name}-report.html")
