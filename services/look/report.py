"""`verso report`: a dataset as one HTML page that needs nothing beside it; and the pages of the server."""

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from string import Template
from urllib.parse import quote

import trimesh

from schemas.errors import MachineError, OutputError, command_line, plural
from services.job.record import JobRecord, read_success, require_job
from services.look.charts import Histogram
from services.look.clouds import Space, pack_spaces, read_spaces
from services.look.collect import MOST_RANGES, Figures, SceneTable, choose_looks, collect, read_scene_table
from services.look.pictures import ShownScene, choose_scenes, show_scenes
from services.look.sections import (
    charts_html,
    effects_html,
    failures_html,
    look_html,
    overview_html,
    scene_table_html,
    space_html,
)
from services.look.sheets import Address, compare_html, sheets_html, strip_html
from services.read.dataset_reader import StoredTables
from workers.store.store import Store

WEB = Path(__file__).with_name("web")

POLICY = (
    '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'\">"
)
"""The browser itself then holds the page to fetching nothing."""

SCRIPTS = ("three.js", "page.js", "space.js")


@dataclass(frozen=True)
class Section:
    """A part of the page: its id and place in the links, its heading, and its HTML."""

    id: str
    heading: str
    html: str


@dataclass(frozen=True)
class Page:
    """What the page says."""

    title: str
    subtitle: str
    sections: Sequence[Section]
    footer: str


def whole_page(page: Page, names: Sequence[str] = SCRIPTS, style: str = "") -> str:
    """The page with everything that it needs inside: these scripts, and more rules of style."""
    style = f"<style>{read_web('page.css')}{style}</style>"
    icon = f"data:image/svg+xml,{quote(read_web('icon.svg').strip())}"
    scripts = "".join(f"<script>{read_web(name)}</script>\n" for name in names)
    return fill_page(page, policy=POLICY, style=style, icon=icon, scripts=scripts, data="")


def section_html(section: Section) -> str:
    """One section with its heading."""
    head = f'<h2 id="{section.id}-heading">{escape(section.heading)}</h2>'
    return f'<section id="{section.id}" aria-labelledby="{section.id}-heading">{head}\n{section.html}</section>\n'


def read_web(name: str) -> str:
    """A file of the folder `web`, or `three.js`."""
    return read_three() if name == "three.js" else (WEB / name).read_text(encoding="utf-8")


@cache
def read_three() -> str:
    """three.js with its licence line, cut out of the viewer page that trimesh carries: the first block of its script."""
    with zipfile.ZipFile(Path(trimesh.__file__).with_name("resources") / "templates" / "viewer.zip") as packed:
        page = packed.read("viewer.html.template").decode("utf-8")
    script = page.partition("<script>")[2].partition("\n(function(){")[0]
    if "SPDX-License-Identifier: MIT" not in script or "</script" in script:
        raise MachineError("trimesh's viewer does not begin with three.js: install the version in requirements.lock")
    return script


def fill_page(page: Page, **around: str) -> str:
    """The template with all its places filled: `around` has policy, style, icon, scripts, and attributes of the body."""
    shown = [section for section in page.sections if section.html]
    return Template(read_web("page.html")).substitute(
        around,
        title=escape(page.title),
        subtitle=f'<p class="sub">{escape(page.subtitle)}</p>' if page.subtitle else "",
        links="".join(f'<a href="#{section.id}">{escape(section.heading)}</a>' for section in shown),
        sections="".join(map(section_html, shown)),
        footer=f"<footer>{escape(page.footer)}</footer>" if page.footer else "",
    )


_LIVE = (
    '<div id="live-now" aria-live="polite">{}</div>'
    '<p class="empty" id="live-gone" hidden>The server does not answer; this page asks again.</p>'
    '<button type="button" class="quiet" id="live-newer" hidden>Show newer pictures</button>'
)


@dataclass(frozen=True)
class View:
    """What the page shows now."""

    name: str
    """Of the job."""
    title: str
    """Of the window."""
    live: str
    sections: tuple[Section, ...]
    version: int
    """Of the sections."""

    @property
    def shape(self) -> str:
        """The sections that have something to show: a page of another shape is loaded anew."""
        return " ".join(section.id for section in self.sections if section.html)

    def state(self) -> dict[str, object]:
        """What the page asks for every few seconds."""
        names = ("name", "title", "live", "version", "shape")
        return {name: getattr(self, name) for name in names}

    def fragments(self) -> dict[str, object]:
        """The sections by id."""
        return {"version": self.version, "sections": {one.id: section_html(one) for one in self.sections if one.html}}


def live_page(view: View) -> str:
    """The page of a server: its style and scripts lie beside it."""
    page = Page(view.name, "", [Section("live", "Now", _LIVE.format(view.live)), *view.sections], "")
    scripts = "".join(f'<script src="/{name}"></script>\n' for name in (*SCRIPTS, "live.js"))
    data = f' data-version="{view.version}" data-shape="{escape(view.shape)}"'
    style = '<link rel="stylesheet" href="/page.css">'
    return fill_page(page, policy="", style=style, icon="/icon.svg", scripts=scripts, data=data)


@dataclass(frozen=True)
class Report:
    """What a page is made of."""

    record: JobRecord
    digest: str | None
    """Of the finished dataset."""
    figures: Figures
    scenes: list[ShownScene]
    depth: Mapping[str, Histogram]
    """Of the object pixels in these scenes, by role, metres."""
    spaces: tuple[Space, ...]
    table: SceneTable
    looks: list[ShownScene]
    """Scenes with different looks, in colour."""
    place: str
    """Of the dataset."""


def read_report(store: Store, scenes: int) -> Report:
    """Figures of the whole dataset, and the pictures of about `scenes` scenes.

    Raises OutputError where there is no dataset, CorruptError where a file is damaged.
    """
    record = require_job(store)
    tables = StoredTables(store, MOST_RANGES)
    shown, depth = show_scenes(store, choose_scenes(tables, scenes))
    spaces = read_spaces(store, [scene.scene_id for scene in shown])
    figures = collect(tables)
    table = read_scene_table(tables, record.job.assets.split, figures.scenes)
    looks, _ = show_scenes(store, choose_looks(tables), ("rgb",))
    digest = (read_success(store) or {}).get("digest")
    return Report(record, digest, figures, shown, depth, spaces, table, looks, store.name)


def page_of(report: Report, address: Address) -> Page:
    """The page of a report, with its pictures at these addresses."""
    figures, scenes, job = report.figures, report.scenes, report.record.job
    failed, shown, there = sum(failure.scenes for failure in figures.failures), len(scenes), figures.scenes
    more = f" More: {command_line('report', report.place, '--scenes', there)}" if shown < there else ""
    chosen = f'<p class="note">{shown} of {plural(there, "scene")}, chosen evenly from each category.{escape(more)}</p>'
    sections = (
        Section("overview", "Overview", overview_html(figures, job, failed, report.table.splits)),
        Section("scenes", "All scenes", scene_table_html(report.table, report.place)),
        Section("pictures", "Pictures", sheets_html(scenes, address) + chosen),
        Section("compare", "Compare", compare_html(scenes)),
        Section("space", "In space", space_html(report.spaces, pack_spaces(report.spaces))),
        Section("figures", "Figures", charts_html(figures, report.depth)),
        Section("look", "Look", look_html(figures, [strip_html(one, address) for one in report.looks if one.pictures])),
        Section("effects", "Effects", effects_html(figures)),
        Section("failures", "Failures", failures_html(figures.failures, figures.scenes + failed)),
    )
    what = "captures" if job.captures is not None else "scenes"
    state = f"finished, digest {report.digest[:12]}" if report.digest else "not finished"
    footer = f"Job {report.record.digest[:12]}. Made by verso report; this page fetches nothing."
    return Page(job.name, f"{job.scenes:,} {what} asked, seed {job.seed}, {state}", sections, footer)


def write_report(store: Store, scenes: int, target: Path) -> tuple[int, Report]:
    """(bytes written, what the page was made of). Raises OutputError where the file cannot be written."""
    report = read_report(store, scenes)
    data = whole_page(page_of(report, lambda picture: picture.inline)).encode()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    except OSError as error:
        raise OutputError(f"{target} cannot be written: {error.strerror or error}; choose another --out") from error
    return len(data), report
