"""The whole page from its sections, style and scripts: one file that fetches nothing, or the page of a server."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from urllib.parse import quote

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


@dataclass(frozen=True)
class Around:
    """What is not the same in a file and on a server."""

    policy: str
    style: str
    icon: str
    scripts: str
    data: str = ""
    """Attributes of the body."""


def whole_page(page: Page) -> str:
    """The page with everything that it needs inside."""
    style = f"<style>{read_web('page.css')}</style>"
    icon = f"data:image/svg+xml,{quote(read_web('icon.svg').strip())}"
    return fill_page(
        page, Around(POLICY, style, icon, "".join(f"<script>{read_web(name)}</script>\n" for name in SCRIPTS))
    )


def section_html(section: Section) -> str:
    """One section with its heading."""
    head = f'<h2 id="{section.id}-heading">{escape(section.heading)}</h2>'
    return f'<section id="{section.id}" aria-labelledby="{section.id}-heading">{head}\n{section.html}</section>\n'


def read_web(name: str) -> str:
    """A file of the folder `web`."""
    return (WEB / name).read_text(encoding="utf-8")


def fill_page(page: Page, around: Around) -> str:
    """The template with all its places filled."""
    shown = [section for section in page.sections if section.html]
    return Template(read_web("page.html")).substitute(
        policy=around.policy,
        data=around.data,
        icon=around.icon,
        title=escape(page.title),
        subtitle=f'<p class="sub">{escape(page.subtitle)}</p>' if page.subtitle else "",
        style=around.style,
        links="".join(f'<a href="#{section.id}">{escape(section.heading)}</a>' for section in shown),
        sections="".join(map(section_html, shown)),
        footer=f"<footer>{escape(page.footer)}</footer>" if page.footer else "",
        scripts=around.scripts,
    )
