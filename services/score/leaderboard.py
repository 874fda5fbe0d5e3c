"""Edge: `verso score merge` makes one table of several scores, and says who is surely better than whom.

A run that leaves anything out is in the table, and is not compared.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.errors import InputError
from services.run.progress import finish
from services.score.command import (
    SHOWN,
    covered,
    in_words,
    interval,
    is_whole,
    read_score,
    require_alike,
    words,
    write_text,
)
from services.score.summary import LEVEL, Figure, compare, decide, summarise


def main(options: argparse.Namespace) -> int:
    """0 where every run is whole. Raises InputError where runs are not scored, or not alike."""
    scores = {_name(run, options.runs): read_score(options.out, run) for run in options.runs}
    if len(scores) < len(options.runs):
        raise InputError("a run is named twice")
    (first, (_, head)), *others = scores.items()
    for name, (_, other) in others:
        require_alike(options.out, first, head, name, other)
    summaries = {name: summarise(table) for name, (table, _) in scores.items()}
    metrics = [name for name in SHOWN if any(_figure(summary, name) for summary in summaries.values())]
    verdicts = compare_all({name: table for name, (table, _) in scores.items()})
    options.target.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist([*_rows(summaries, metrics)]), options.target / "leaderboard.parquet")
    tables, sentences = [*_markdown(summaries, metrics)], describe_verdicts(verdicts, summaries)
    write_text(options.target / "leaderboard.md", "\n\n".join([tables[0], sentences, *tables[1:]]) + "\n")
    write_text(options.target / "leaderboard.tex", "\n\n".join(_latex(summaries, metrics)) + "\n")
    print(f"{tables[0]}\n\n{sentences}\n\nby category: {options.target / 'leaderboard.md'}")
    return finish(
        options,
        all(map(is_whole, summaries.values())),
        runs=[*summaries],
        verdicts=verdicts,
        folder=str(options.target),
    )


def _name(run: Path, runs: Sequence[Path]) -> str:
    """The last parts of a run's path that tell it from the others."""
    parts = run.parts[:-1] if run.name == "score" else run.parts
    others = [other.parts for other in runs if other != run]
    for count in range(1, len(parts)):
        if all(other[-count:] != parts[-count:] for other in others):
            return "/".join(parts[-count:])
    return str(run)


def _figure(summary: Mapping[str, Any], name: str) -> Figure | None:
    figure = summary["metrics"].get(name)
    return figure if figure and figure["items"] else None


def compare_all(tables: Mapping[str, pa.Table], metrics: Sequence[str] = SHOWN) -> list[dict[str, Any]]:
    """Each pair of whole runs by each metric: `metric`, `a`, `b`, `p` by Holm, and the `better`, None where that is not sure."""
    pairs = {(a, b): compare(tables[a], tables[b], metrics) for a, b in combinations(tables, 2)}
    decide([row for rows in pairs.values() for row in rows.values()])
    return [
        {"metric": metric, "a": a, "b": b, "p": row["p"], "better": {"a": a, "b": b}.get(row["better"])}
        for metric in metrics
        for (a, b), rows in pairs.items()
        if (row := rows.get(metric)) and row["p"] is not None
    ]


def describe_verdicts(verdicts: Sequence[Mapping[str, Any]], summaries: Mapping[str, Any]) -> str:
    """Lines of Markdown: by metric whom each run beats surely, and which pairs are not told apart."""
    lines = [
        f"Wilcoxon's signed-rank test over scenes, Holm's correction over {len(verdicts)} comparisons, level {LEVEL:g}."
    ]
    for metric in dict.fromkeys(verdict["metric"] for verdict in verdicts):
        each = [verdict for verdict in verdicts if verdict["metric"] == metric]
        for run in summaries:
            beaten = [v["b"] if run == v["a"] else v["a"] for v in each if v["better"] == run]
            if beaten:
                lines.append(f"- {words(metric)}: {run} is better than {', '.join(beaten)}.")
        if same := [f"{verdict['a']} and {verdict['b']}" for verdict in each if verdict["better"] is None]:
            lines.append(f"- {words(metric)}: not told apart: {'; '.join(same)}.")
    for run, summary in summaries.items():
        if part := [
            name
            for name, figure in summary["metrics"].items()
            if name in SHOWN and figure["coverage"] not in (None, 1.0)
        ]:
            lines.append(f"- {run} is not compared by {', '.join(map(words, part))}: it leaves items or pixels out.")
    return "\n".join(lines)


def _rows(summaries: Mapping[str, Any], metrics: Sequence[str]) -> Iterator[dict[str, Any]]:
    """A row for each run, metric and category; of all categories the category is null."""
    for run, summary in summaries.items():
        for category, figures in ((None, summary["metrics"]), *summary["by"]["category"].items()):
            for metric in metrics:
                if figure := figures.get(metric):
                    yield {"run": run, "category": category, "metric": metric, **figure}


def _tables(summaries: Mapping[str, Any], metrics: Sequence[str]) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """(title, head, rows) of all items and, by category, of the first metric that all have."""
    yield (
        "all",
        ["run", *map(words, metrics), "coverage"],
        [
            [run, *(_cell(name, summary["metrics"].get(name)) for name in metrics), _least_coverage(summary, metrics)]
            for run, summary in summaries.items()
        ],
    )
    for metric in metrics:
        categories = sorted({name for summary in summaries.values() for name in summary["by"]["category"]})
        rows = [
            [run, *(_cell(metric, summary["by"]["category"].get(name, {}).get(metric)) for name in categories)]
            for run, summary in summaries.items()
            if _figure(summary, metric)
        ]
        yield words(metric), ["run", *categories], rows


def _cell(metric: str, figure: Figure | None) -> str:
    if not figure or not figure["items"]:
        return ""
    ends = interval(metric, figure)
    return f"{in_words(metric, figure['value'])}{ends and f' ({ends})'}"


def _least_coverage(summary: Mapping[str, Any], metrics: Sequence[str]) -> str:
    figures = [figure for name in metrics if (figure := _figure(summary, name))]
    return covered(min(figures, key=lambda figure: figure["coverage"] or 0.0)).removeprefix("coverage ")


def _markdown(summaries: Mapping[str, Any], metrics: Sequence[str]) -> Iterator[str]:
    for title, head, rows in _tables(summaries, metrics):
        lines = [head, ["---"] * len(head), *rows]
        yield f"**{title}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _latex(summaries: Mapping[str, Any], metrics: Sequence[str]) -> Iterator[str]:
    for title, head, rows in _tables(summaries, metrics):
        lines = [" & ".join(map(_escape, line)) + r" \\" for line in (head, *rows)]
        yield "\n".join(
            [
                f"% {title}",
                rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
                lines[0],
                r"\hline",
                *lines[1:],
                r"\end{tabular}",
            ]
        )


def _escape(text: str) -> str:
    for character in "%_&#":
        text = text.replace(character, f"\\{character}")
    return text.replace("°", r"$^\circ$").replace("²", r"$^2$")
