import json

from services.cli.commands import default_page
from services.cli.main import main
from tests.datasets import make_dataset


def test_a_report_says_what_it_wrote_and_what_it_shows(tmp_path, capsys):
    store, _ = make_dataset(tmp_path / "small", scenes=2, categories=["box"])
    assert main(["report", str(store.root), "--scenes", "1", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    page = tmp_path / "small-report.html"
    assert answer["file"] == str(page) and answer["bytes"] == page.stat().st_size
    assert (answer["scenes"], len(answer["shown"])) == (2, 1)


def test_the_page_lies_beside_its_dataset_and_never_in_it(tmp_path):
    assert default_page(f"{tmp_path}/small/") == tmp_path / "small-report.html"
    assert str(default_page("s3://bucket/sets/small")) == "small-report.html"
