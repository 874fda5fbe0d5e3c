"""`verso export`: a dataset in another layout, scene by scene in constant memory, gone on with after a kill."""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Set
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError, OutputError, command_line, did_you_mean, plural
from services.dataset.dataset import Dataset
from services.export.folder import ExportFolder
from services.export.formats import Choice, ExportRequest, Writer, choose_scenes
from services.export.source import iter_records, scenes_of, splits_of
from services.export.table import FORMATS
from services.job.record import JobRecord, read_success, require_dataset, require_job
from services.read.query import query
from services.read.verdict import explain_damage
from services.run.progress import ProgressLine, finish
from workers.store.commit import list_codes
from workers.store.local import open_store

LEFT_OUT: Final = "left_out.csv"
VERSION: Final = 1
"""Of export.json."""


@dataclass(frozen=True)
class ExportResult:
    """What an export holds: its manifest, and how many pairs this call wrote."""

    manifest: dict[str, Any]
    pairs_now: int


Report = Callable[[int, int], None]
"""Is told how many committed scenes were gone through, and how many there are."""


def export(request: ExportRequest, report: Report = lambda done, asked: None) -> ExportResult:
    """Writes the export, or goes on where it was killed; a finished one is left as it is.

    Raises OutputError where the folder is not this export's, InputError for a condition that cannot be asked, CorruptError
    where a stored file is missing or damaged.
    """
    root = request.store.root
    if root is not None and request.target.resolve().is_relative_to(Path(root).resolve()):  # it would be a foreign file
        raise OutputError(f"{request.target} lies in the dataset {request.store.name}: choose a DIR beside it")
    record = require_job(request.store)
    FORMATS[request.format].load().check(request.format, record.job)
    folder = ExportFolder(request.target)
    plan = _plan(request, record)
    if (done := folder.finished()) is not None:
        folder.refuse_other(done, plan)
        return ExportResult(done, 0)
    chosen = choose_scenes(request.store, request.choice)
    if not folder.work.exists():
        _refuse_empty(request, chosen)
    with folder.claimed(plan) as progress:
        codes = _snapshot(request, folder, fresh=progress is None)
        begun = progress or {"next_scene": 0, "finished": False, "counts": {}, "left_out": {}, "writer": None}
        writer = FORMATS[request.format].load()(request, record, folder, begun["writer"])
        with closing(writer):
            return _Export(writer, codes, begun).run(chosen, report)


def _refuse_empty(request: ExportRequest, chosen: Set[int]) -> None:
    """Raises InputError where no object has a category that is named, or no scene is chosen: before anything is written."""
    store, choice = request.store, request.choice
    for option, names, table in (
        ("--category", choice.categories, "scenes"),
        ("--held-out", choice.held_out, "assets"),
    ):
        there = (
            query(store, f"select distinct category from {table} order by 1")["category"].to_pylist() if names else []
        )
        if unknown := sorted(set(names) - set(there)):
            known = f"{did_you_mean(unknown[0], there)}Its are {', '.join(there)}"
            raise InputError(f"{option} {unknown[0]}: {store.name} has no such object; {known}")
    if not chosen:
        listed = command_line("query", store.name, "select scene_id, category from scenes")
        raise InputError(f"no scene of {store.name} is what was asked for: `{listed}` lists what is there")


class _Export:
    """An export on its way: the writer, the commits, and how far it came."""

    def __init__(self, writer: Writer, codes: NDArray[np.int64], begun: dict[str, Any]) -> None:
        self._writer, self._codes, self._folder = writer, codes, writer.folder
        self._finished: bool = begun["finished"]
        self._next_scene: int = begun["next_scene"]
        self._counts, self._left_out = Counter(begun["counts"]), Counter(begun["left_out"])
        if begun["writer"] is None:
            self._folder.append(LEFT_OUT, b"scene_id,pose_id,reason\n")

    def run(self, chosen: Set[int], report: Report) -> ExportResult:
        """Every chosen scene from the checkpoint on, then the manifest."""
        before = self._counts["pairs"]
        if not self._finished:
            self._write_scenes(chosen, report)
            self._writer.finish()
            self._finished = True
            self._checkpoint(self._next_scene)
        counts = {name: self._counts[name] for name in ("scenes", "pairs", "pairs_left_out")}
        left_out = dict(sorted(self._left_out.items()))
        manifest = {**self._folder.plan, "ranges": len(self._codes), **counts, "left_out": left_out}
        described = self._writer.describe()
        if reserved := sorted(described.keys() & manifest.keys()):
            raise ValueError(
                f"the writer of {self._writer.request.format} describes {', '.join(reserved)}: export.json has that"
            )
        manifest |= described
        self._writer.close()
        self._folder.finish(manifest)
        return ExportResult(manifest, self._counts["pairs"] - before)

    def _write_scenes(self, chosen: Set[int], report: Report) -> None:
        store, job, choice = self._writer.request.store, self._writer.record.job, self._writer.request.choice
        splits = splits_of(store, self._codes, job.assets.split, choice.held_out, choice.split == "category")
        dataset = Dataset(store)
        for records in iter_records(store, self._codes):
            first, stop = max(self._next_scene, records[0].span.start), records[0].span.stop
            if stop <= first:
                continue
            for scene in scenes_of(dataset, records, chosen & set(range(first, stop)), splits):
                left_out = self._writer.add(scene)
                pairs = len(scene.pairs) - len(left_out)
                self._counts.update(scenes=int(pairs > 0), pairs=pairs, pairs_left_out=len(left_out))
                self._left_out.update(reason for _, reason in left_out)
                for pose_id, reason in left_out:
                    self._folder.append_row(LEFT_OUT, (scene.scene_id, pose_id, reason))
                self._checkpoint(scene.scene_id + 1)
            self._checkpoint(max(self._next_scene, stop))
            report(stop, job.stop_scene)

    def _checkpoint(self, next_scene: int) -> None:
        self._next_scene = next_scene
        if (state := self._writer.state()) is not None:
            now = {"next_scene": next_scene, "finished": self._finished}
            self._folder.checkpoint({**now, "counts": self._counts, "left_out": self._left_out, "writer": state})


def _plan(request: ExportRequest, record: JobRecord) -> dict[str, Any]:
    """What makes two exports the same: nothing of this machine."""
    return {
        "verso_export": VERSION,
        "format": request.format,
        "dataset": record.job.name,
        "job_digest": record.digest,
        "dataset_digest": (read_success(request.store) or {}).get("digest"),
        "choice": request.choice.model_dump(mode="json", exclude_defaults=True),
        **({"shard_mb": request.shard_mb, "points": request.points} if FORMATS[request.format].sharded else {}),
    }


def _snapshot(request: ExportRequest, folder: ExportFolder, fresh: bool) -> NDArray[np.int64]:
    """The commits that the export is of: those that were there when it began, also where a run adds more."""
    kept = folder.work / "commits.npy"
    if fresh or not kept.exists():
        codes = list_codes(request.store)
        temporary = folder.temporary("commits.npy")
        np.save(temporary, codes)
        folder.install(temporary, f"{folder.work.name}/{kept.name}")
    return np.load(kept)


def main(options: argparse.Namespace) -> int:
    """Export what the options ask for; returns 0, or 1 where no pair could be exported."""
    if "://" in options.dir:
        raise OutputError(f"{options.dir} is not a folder: export into one on this machine, and copy it there")
    store = require_dataset(open_store(options.out))
    first, last = options.scenes or (None, None)
    choice = Choice(
        categories=tuple(options.category),
        first_scene=first,
        last_scene=last,
        where=options.where,
        split=options.split,
        held_out=tuple(options.held_out),
    )
    request = ExportRequest(store, Path(options.dir), options.format, choice, options.shard_mb, options.points or 0)
    begun = time.monotonic()
    with explain_damage(store), closing(ProgressLine(0, "export")) as line:

        def report(done: int, asked: int) -> None:
            line.expect(asked)
            line.show(done)

        result = export(request, report)
    _print_result(options, result, time.monotonic() - begun)
    pairs = result.manifest["pairs"] > 0
    return finish(options, pairs, dir=options.dir, pairs_now=result.pairs_now, **result.manifest)


def _print_result(options: argparse.Namespace, result: ExportResult, seconds: float) -> None:
    """Prints what the export holds and what it leaves out."""
    manifest = result.manifest
    now = f" ({result.pairs_now} now, in {seconds:.1f} s)" if result.pairs_now else " (nothing was left to do)"
    pairs, scenes = plural(manifest["pairs"], "pair"), plural(manifest["scenes"], "scene")
    print(f"{options.dir}: {options.format}, {pairs} of {scenes}{now}")
    for reason, count in manifest["left_out"].items():
        print(f"  left out: {plural(count, 'pair')}, {reason}")
    if manifest["pairs_left_out"]:
        print(f"  {Path(options.dir) / LEFT_OUT} names each of them")
    for line in manifest.get("not_exported", ()):
        print(f"  not exported: {line}")
    if not manifest["pairs"]:
        print(f"verso: {options.dir} holds no pair: every pair was left out", file=sys.stderr)
