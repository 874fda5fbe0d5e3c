"""The dashboard and the scrape configuration, against what a run serves."""

import json
import re
from pathlib import Path

import pytest
import yaml

from services.run.metrics import Counts, Meter

MONITORING = Path(__file__).resolve().parents[2] / "deploy" / "monitoring"
BOARD = json.loads((MONITORING / "grafana-dashboard.json").read_text())
COLUMNS = 24
"""Of Grafana's grid."""


def served() -> dict[str, set[str]]:
    """Names of samples and their labels."""
    meter = Meter("mugs")
    meter.show(Counts(asked=1, failed={"a": 1}, lost={"b": 1}, seconds={"c": 1.0}))
    samples = [sample for family in meter.collect() for sample in family.samples]
    return {sample.name: set(sample.labels) for sample in samples}


def questions() -> list[str]:
    """Every PromQL expression of the dashboard."""
    return [target["expr"] for panel in BOARD["panels"] for target in panel["targets"]]


def test_every_metric_and_label_that_the_dashboard_asks_for_is_served():
    names = served()
    for expression in questions():
        asked = re.findall(r"(verso_\w+)(?:\{(\w+))?", expression)
        assert asked, expression
        for name, label in asked:
            assert name in names, expression
            assert not label or label in names[name], expression
        for labels in re.findall(r"by \(([^)]*)\)", expression):
            known = set().union(*(names[name] for name, _ in asked))
            assert set(re.split(r",\s*", labels)) <= known, expression


def test_every_metric_that_is_served_is_shown():
    shown = " ".join(questions())
    assert [name for name in served() if name not in shown] == []


def test_panels_have_a_number_a_title_and_a_place_of_their_own():
    places = [panel["gridPos"] for panel in BOARD["panels"]]
    taken = [
        (x, y) for at in places for x in range(at["x"], at["x"] + at["w"]) for y in range(at["y"], at["y"] + at["h"])
    ]
    assert len(taken) == len(set(taken)) and max(x for x, _ in taken) < COLUMNS
    assert len({panel["id"] for panel in BOARD["panels"]}) == len(BOARD["panels"])
    assert all(panel["title"] and panel["description"] for panel in BOARD["panels"])


@pytest.mark.parametrize("expression", questions())
def test_brackets_of_every_expression_are_closed(expression):
    opened = []
    for letter in re.sub(r'"[^"]*"', "", expression):
        if letter in "([{":
            opened.append(letter)
        elif letter in ")]}":
            assert opened.pop() + letter in ("()", "[]", "{}")
    assert opened == []


def test_the_scrape_keeps_the_label_of_the_job():
    """Prometheus has a label `job` of its own, and renames ours unless told otherwise."""
    (scrape,) = yaml.safe_load((MONITORING / "prometheus.yml").read_text())["scrape_configs"]
    assert scrape["honor_labels"] is True
    (only,) = scrape["static_configs"]
    assert re.fullmatch(r"[\d.]+:\d+", only["targets"][0])
