"""`verso score`: scores predictions of a dataset, or compares two scores. Writes items.parquet, summary.json, index.html."""

import argparse
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.errors import InputError, plural
from services.dataset.dataset import Dataset
from services.job.record import read_success, require_dataset
from services.read.verdict import explain_damage
from services.score.items import Asked
from services.score.page import answer_of, interval, page_of, told
from services.score.predictions import find_predictions
from services.score.run import ITEMS_FILE, describe_refused, score_dataset
from services.score.summary import HEADLINES, compare, summarise
from workers.store.local import open_store

SUMMARY_FILE, PAGE_FILE = "summary.json", "index.html"

SCORE_VERSION = 1
"""The version of the format of summary.json."""


def main(options: argparse.Namespace) -> int:
    """0 where nothing was refused. Raises InputError where there is nothing to score, CorruptError where OUT is damaged."""
    store = require_dataset(open_store(options.out))
    if options.compare is not None:
        return _compare(options)
    if options.predictions is None:
        raise InputError(
            "name the folder of predictions: verso score OUT PREDICTIONS, or --compare A B for two that are scored"
        )
    given = find_predictions(options.predictions)
    asked = Asked(given.kinds, options.frame, align=options.align, flip=options.flip)
    target = options.score or options.predictions / "score"
    with explain_damage(store):
        path = score_dataset(store, given, asked, target)
        table = pq.read_table(path)
        digest = (read_success(store) or {}).get("digest")
        head = {
            "verso_score": SCORE_VERSION,
            "dataset": options.out,
            "digest": digest,
            "predictions": str(given.folder),
        }
        summary = {**head, **asdict(asked), **summarise(table)}
        _write(target / SUMMARY_FILE, json.dumps(summary, indent=1) + "\n")
        troubles = describe_refused(path)
        _write(target / PAGE_FILE, page_of(summary, table, troubles, Dataset(store), given))
    for line in troubles:
        print(f"verso: {line}", file=sys.stderr)
    _print_metrics(summary["metrics"])
    print(answer_of(summary))
    print(f"page: {target / PAGE_FILE}")
    answer = {name: summary[name] for name in ("items", "missing", "refused", "metrics")}
    return _finish(options, not summary["refused"], answer | {"page": str(target / PAGE_FILE)})


def _print_metrics(metrics: dict[str, Any]) -> None:
    for name, one in metrics.items():
        if name in HEADLINES and one["items"]:
            print(f"{name:28}{told(name, one['value']):>12}  {interval(name, one):28}{plural(one['items'], 'item')}")


def _compare(options: argparse.Namespace) -> int:
    """Prints which of two scores is better by each metric, with a paired interval."""
    (a, one), (b, other) = (_read_score(path) for path in options.compare)
    if one["digest"] != other["digest"] or one["dataset"] != other["dataset"] != options.out:
        raise InputError(f"{options.compare[0]} and {options.compare[1]} are scores of different datasets")
    if one["align"] != other["align"]:
        how = f"with --align {one['align']} and {other['align']}"
        raise InputError(f"{options.compare[0]} and {options.compare[1]} were scored {how}: score both alike")
    found = compare(a, b)
    for name in [name for name in found if name in HEADLINES]:
        row = found[name]
        verdict = {"a": f"{options.compare[0]} is better", "b": f"{options.compare[1]} is better", None: "not decided"}[
            row["better"]
        ]
        print(
            f"{name:28}{told(name, row['a']):>12}{told(name, row['b']):>12}  b - a: {interval(name, row):28}{verdict}"
        )
    return _finish(options, True, {"a": str(options.compare[0]), "b": str(options.compare[1]), "metrics": found})


def _read_score(path: Path) -> tuple[pa.Table, dict[str, Any]]:
    """The items and the summary of a folder of predictions or of its score. Raises InputError where it is not scored."""
    for folder in (path, path / "score"):
        if (folder / ITEMS_FILE).is_file() and (folder / SUMMARY_FILE).is_file():
            return pq.read_table(folder / ITEMS_FILE), json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8"))
    raise InputError(f"{path} has no score: make one with verso score OUT {path}")


def _write(path: Path, text: str) -> None:
    """Whole or not at all."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def _finish(options: argparse.Namespace, ok: bool, answer: dict[str, Any]) -> int:
    if options.json:
        print(json.dumps({"ok": ok, **answer}))
    return 0 if ok else 1
