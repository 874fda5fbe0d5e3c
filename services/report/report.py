"""`verso report`: a dataset as one HTML page that needs nothing beside it: no file, no network."""

from dataclasses import dataclass
from pathlib import Path

from schemas.errors import OutputError
from schemas.job.job import Job
from services.job.record import JobRecord, require_job
from services.merge.merge import read_success
from services.report.beside import Side, beside_html
from services.report.clouds import Space, pack_space, read_space
from services.report.collect import Figures, collect
from services.report.gallery import Address, compare_html, sheets_html, space_html
from services.report.page import Page, Section, whole_page
from services.report.sample import Sample, choose_scenes, show_scenes
from services.report.sections import captures_html, charts_html, effects_html, failures_html, overview_html
from services.report.tables import open_tables
from workers.store.store import Store

SCENES = 24
"""Scenes whose pictures are shown, unless told otherwise."""


@dataclass(frozen=True)
class Report:
    """What a page is made of."""

    record: JobRecord
    digest: str | None
    """Of the finished dataset."""
    figures: Figures
    sample: Sample
    space: Space | None


def read_report(store: Store, scenes: int) -> Report:
    """Figures of the whole dataset, and the pictures of about `scenes` scenes.

    Raises OutputError where there is no dataset, CorruptError where a file is damaged.
    """
    record = require_job(store)
    tables = open_tables(store)
    figures = collect(tables)
    sample = show_scenes(store, choose_scenes(tables, figures.by_category, scenes))
    space = next(filter(None, (read_space(store, one.scene_id) for one in sample.scenes)), None)
    return Report(record, (read_success(store) or {}).get("digest"), figures, sample, space)


def page_of(report: Report, address: Address, other: Report | None = None) -> Page:
    """The page of a report, with its pictures at these addresses; beside another dataset's, where there is one."""
    figures, sample, job = report.figures, report.sample, report.record.job
    failed = sum(one.scenes for one in figures.failures)
    sections = (
        Section("overview", "Overview", overview_html(figures, job, failed)),
        Section("pictures", "Pictures", sheets_html(sample.scenes, address)),
        Section("compare", "Compare", compare_html(sample.scenes)),
        Section("space", "In space", space_html(report.space, pack_space(report.space) if report.space else "")),
        Section("figures", "Figures", charts_html(figures, sample.depth)),
        Section("effects", "Effects", effects_html(figures)),
        Section("failures", "Failures", failures_html(figures.failures, figures.scenes + failed)),
        Section("captures", "Captures", captures_html(figures)),
        Section("beside", "Side by side", beside_html(_side(report), _side(other), address) if other else ""),
    )
    return Page(job.name, _subtitle(job, report.digest), sections, _footer(report))


def write_report(store: Store, scenes: int, target: Path, beside: Store | None = None) -> tuple[int, Report]:
    """(bytes written, what the page was made of). Raises OutputError where the file cannot be written."""
    report = read_report(store, scenes)
    other = None if beside is None else read_report(beside, scenes)
    data = whole_page(page_of(report, lambda picture: picture.inline, other)).encode()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    except OSError as error:
        raise OutputError(f"{target} cannot be written: {error.strerror or error}; choose another --out") from error
    return len(data), report


def _side(report: Report) -> Side:
    return report.record.job.name, report.figures, report.sample


def _subtitle(job: Job, digest: str | None) -> str:
    what = "captures" if job.captures is not None else "scenes"
    state = f"finished, digest {digest[:12]}" if digest else "not finished"
    return f"{job.scenes:,} {what} asked, seed {job.seed}, {state}"


def _footer(report: Report) -> str:
    shown = len(report.sample.scenes)
    return (
        f"Pictures are of {shown} scenes, chosen evenly from each category. Job {report.record.digest[:12]}. "
        "Made by verso report; this page fetches nothing."
    )
