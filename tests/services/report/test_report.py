import re
from html.parser import HTMLParser

import pytest

from schemas.errors import OutputError
from services.cli.main import main
from services.look.report import page_of, read_report, write_report
from workers.store.local import LocalStore

VOID = {"meta", "img", "input", "link", "br"}


class Reader(HTMLParser):
    """Ids, addresses and open elements of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.ids += [value for name, value in attrs if name == "id"]
        self.addresses += [value for name, value in attrs if name in ("src", "href", "srcset", "action", "data")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.ids += [value for name, value in attrs if name == "id"]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"</{tag}> closes another element"


@pytest.fixture(scope="module")
def page(shown, tmp_path_factory) -> str:
    file = tmp_path_factory.mktemp("page") / "page.html"
    write_report(shown, 2, file)
    return file.read_text()


def test_every_element_is_closed_and_every_id_is_unique(page):
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    assert len(set(reader.ids)) == len(reader.ids) > 5


def test_the_page_holds_all_that_it_shows(page):
    reader = Reader()
    reader.feed(page)
    inner = [address for address in reader.addresses if address.startswith("#")]
    assert {address[1:] for address in inner} <= set(reader.ids)
    assert all(address.startswith("data:image/") for address in reader.addresses if address not in inner)
    style = re.search(r"<style>(.*?)</style>", page, re.DOTALL)[1]
    assert "url(" not in style and "@import" not in style
    assert "default-src 'none'" in page


def test_the_page_names_its_job_and_its_totals(shown, page):
    assert "<title>small</title>" in page
    assert "4 scenes asked" in page
    report = read_report(shown, 2)
    assert report.figures.scenes == 4
    assert [section.id for section in page_of(report, lambda picture: picture.name).sections][:2] == [
        "overview",
        "pictures",
    ]


def test_a_folder_without_a_dataset_is_refused(tmp_path):
    with pytest.raises(OutputError, match=r"holds no job\.yaml"):
        write_report(LocalStore(tmp_path), 2, tmp_path / "page.html")


def test_a_page_that_cannot_be_written_is_told_with_its_remedy(shown, tmp_path, capsys):
    (tmp_path / "file").touch()
    assert main(["report", str(shown.root), "--out", str(tmp_path / "file" / "page.html")]) == 2
    assert "choose another --out" in capsys.readouterr().err
