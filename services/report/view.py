"""What the live page shows at a moment: as a page, and as answers to a page that asks for what is new. Pure."""

from dataclasses import dataclass
from html import escape

from services.report.page import SCRIPTS, Around, Page, Section, fill_page, section_html

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
        shown = {"name": self.name, "title": self.title, "live": self.live}
        return {**shown, "version": self.version, "shape": self.shape}

    def fragments(self) -> dict[str, object]:
        """The sections by id."""
        return {"version": self.version, "sections": {one.id: section_html(one) for one in self.sections if one.html}}


def live_page(view: View) -> str:
    """The page of a server: its style and scripts lie beside it."""
    page = Page(view.name, "", [Section("live", "Now", _LIVE.format(view.live)), *view.sections], "")
    scripts = "".join(f'<script src="/{name}"></script>\n' for name in (*SCRIPTS, "live.js"))
    data = f' data-version="{view.version}" data-shape="{escape(view.shape)}"'
    return fill_page(page, Around("", '<link rel="stylesheet" href="/page.css">', "/icon.svg", scripts, data))
