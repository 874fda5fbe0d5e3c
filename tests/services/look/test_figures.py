"""Figures against tables made by hand, where each can be counted, and the sections of the page that show them."""

import re
import shutil
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from schemas.dataset.layout import SUCCESS_FILE
from schemas.job.assets import SplitShares
from schemas.job.job import Job
from services.dataset.dataset import open_dataset
from services.look.charts import FINE, HEIGHT, Chart, Histogram, amount, bars_of, chart_html
from services.look.collect import (
    COLUMNS,
    MOST_RANKED,
    Cost,
    Failure,
    SceneTable,
    choose_looks,
    collect,
    read_scene_table,
    worst_first,
)
from services.look.sections import charts_html, effects_html, failures_html, look_html, overview_html, scene_table_html
from services.read.dataset_reader import StoredTables
from services.read.query import query
from tests.made_up_scenes import attempt_at
from tests.services.look.conftest import HOSTILE, Handmade
from workers.store.local import LocalStore


def test_tables_made_by_hand_give_the_figures_that_can_be_counted(figures):
    assert (figures.scenes, figures.by_category) == (3, {"box": 1, "mug": 2})
    assert (figures.views, figures.pairs, figures.files, figures.bytes) == (4, 2, 5, 400)
    assert (figures.instances, figures.seconds, figures.sampled) == (2, 7.0, False)
    drop, rgb, glass = (figures.effects[name] for name in ("drop", "rgb", "glass"))
    assert (drop.runs, drop.seconds, drop.timed, drop.skips) == (3, 1.25, 2, {})
    assert (rgb.runs, rgb.timed, dict(rgb.skips)) == (2, 0, {"off": 1})
    assert (glass.runs, dict(glass.skips)) == (0, {"no glass": 2, "not asked": 1})
    assert next(iter(figures.effects)) == "drop" and list(figures.stages) == ["render", "physics"]
    assert (figures.stages["physics"].seconds, figures.stages["physics"].timed) == (2.0, 2)
    assert figures.visibility["input"].count == 1 and figures.visibility["input"].least == 0.5
    assert figures.visibility["mirror"].most == 1.0
    assert (figures.inclination["input"].least, figures.inclination["input"].most) == pytest.approx((45.0, 47.0))
    assert (figures.distance.count, figures.distance.least, figures.distance.most) == (2, 2.1, 2.5)
    first, second = figures.failures
    assert (first.reason, first.scenes, first.examples, first.detail) == ("left_table", 2, [2, 4], "at 0.7 m")
    assert (second.reason, second.scenes) == ("no_rest", 1)
    none = collect(Handmade())
    assert (none.scenes, none.views, none.failures) == (0, 0, [])


def test_every_scene_has_its_split_and_figures_the_worst_first_and_so_has_a_capture(shown, captures):
    table = read_scene_table(StoredTables(shown), SplitShares(), 4)
    rows = {row["scene_id"]: row for row in table.rows}
    assert set(rows) == {0, 1, 2, 3} and sum(map(Counter.total, table.splits.values())) == 4
    dataset = open_dataset(shown.root)
    splits = dataset.splits()
    for pair in dataset.pairs():
        row = rows[pair.scene_id]
        assert row["split"] == splits[pair.instance_id] and row["category"] == pair.category
        assert row["visible, %"] == pytest.approx(
            100 * min(pair.input.visible_fraction, pair.mirror.visible_fraction), abs=1e-3
        )
        assert row["support margin, mm"] == pytest.approx(pair.scene["support_margin_mm"], abs=1e-3)
    html = scene_table_html(read_scene_table(StoredTables(captures), SplitShares(), 1), "my data")
    assert "corner error, px" in html and "penetration" not in html and "verso query &#x27;my data&#x27;" in html
    assert scene_table_html(read_scene_table(StoredTables(shown), SplitShares(), MOST_RANKED + 1), "d") == ""


def test_a_scene_is_as_bad_as_the_figure_in_which_most_others_do_better():
    usual = dict.fromkeys(COLUMNS) | {
        "visible, %": 90.0,
        "penetration, mm": 0.0,
        "hover, mm": None,
        "processor, s": 1.0,
    }
    odd = [{}, {"penetration, mm": 0.2}, {"visible, %": 20.0}, {"visible, %": 60.0}, {"processor, s": 99.0}, {}]
    ranked = worst_first([{**usual, "scene_id": at, **changes} for at, changes in enumerate(odd)])
    assert [row["scene_id"] for row in ranked] == [1, 2, 3, 0, 4, 5]
    assert [row["worst"] for row in ranked[:3]] == ["penetration, mm", "visible, %", "visible, %"]


def test_an_unfinished_dataset_has_the_figures_of_a_finished_one_and_of_many_ranges_some_are_read_evenly(
    shown, tmp_path, unflushed
):
    shutil.copytree(shown.root, tmp_path / "copy")
    (tmp_path / "copy" / SUCCESS_FILE).unlink()
    whole, running = (collect(StoredTables(store, 9)) for store in (shown, LocalStore(tmp_path / "copy")))
    assert vars(whole).keys() == vars(running).keys()
    for name, figure in vars(whole).items():
        assert str(figure) == str(vars(running)[name]), name
    assert (whole.scenes, whole.pairs, whole.files) == (4, 8, len(list(shown.root.glob("*/**/*.png"))))
    assert collect(StoredTables(LocalStore(tmp_path / "none"), 9)).scenes == 0
    store = LocalStore(tmp_path / "many")
    store.prepare()
    for start in range(0, 24, 2):
        attempt_at(store, start, start + 2).commit()
    tables = StoredTables(store, 3)
    read = query(tables, "select scene_id from scenes union select scene_id from failures order by 1")
    assert tables.sampled and read.column(0).to_pylist() == [0, 1, 12, 13, 22, 23]


# ---------------------------------------------------------------------------------------------- histograms


def values_of(seed: int = 3, count: int = 5_000) -> np.ndarray:
    return np.random.default_rng(seed).normal(2.4, 0.2, count)


def test_counts_and_percentiles_are_those_of_numpy_whatever_the_batches():
    values, histogram = values_of(), Histogram(0.0, 9.6)
    for part in np.array_split(values, 7):
        histogram = histogram.add(part)
    expected, _ = np.histogram(values, FINE, (0.0, 9.6))
    assert histogram.counts.tolist() == expected.tolist()
    for share in (0.05, 0.5, 0.95):
        assert histogram.percentile(share) == pytest.approx(np.quantile(values, share), abs=9.6 / FINE)
    assert Histogram(0.0, 1.0).add([0.2, 1.0, 1.0, 1.0]).percentile(0.5) == 1.0  # told as it is, not as its step
    assert Histogram(0.0, 1.0).add([0.25]).percentile(0.5) == 0.25
    ends = Histogram(0.0, 1.0).add([np.nan, -5.0, 7.0])
    assert ends.count == 2 and ends.counts[[0, -1]].tolist() == [1, 1]
    assert np.isnan(Histogram(0.0, 1.0).percentile(0.5))


def test_the_bars_hold_every_value_of_all_histograms():
    lower = values_of(4, 100) - 1.1
    edges, (some, others) = bars_of([Histogram(0.0, 9.6).add(values_of()), Histogram(0.0, 9.6).add(lower)], 40)
    assert some.sum() == 5_000 and others.sum() == 100 and 20 <= len(some) == len(others) == len(edges) - 1 <= 40
    assert edges[0] <= lower.min() < values_of().max() <= edges[-1]
    assert np.array_equal(some, np.histogram(values_of(), edges)[0])
    assert bars_of([Histogram(0.0, 1.0)], 40)[1][0].tolist() == [0] * 40


def test_bars_are_as_high_as_their_counts_and_told_in_words():
    def chart(**series) -> str:
        shown = {name: Histogram(0.0, 9.6).add(values) for name, values in series.items()}
        return chart_html(Chart("Depth", shown, "Of pixels.", lambda value: amount(value, "m")))

    html = chart(input=np.repeat([1.0, 2.0, 4.0], [10, 5, 20]))
    heights = [float(height) for height in re.findall(r'height="([\d.]+)"><title>', html)]
    assert [height / max(heights) for height in heights] == pytest.approx([0.5, 0.25, 1.0], abs=0.005)
    assert max(heights) < HEIGHT and re.findall(r": (\d+)</title>", html) == ["10", "5", "20"]
    html = chart(input=np.linspace(1.0, 3.0, 2001))
    assert 'aria-label="Depth. input: median 2' in html and "n = 2,001" in html
    html = chart(input=[1.0, 1.1], mirror=[5.0])  # the second is a line over the same axis
    first, _, last = re.findall(r"<span>([\d.]+) m</span>", html)
    assert html.count('<path class="line"') == 1 and float(first) <= 1.0 and float(last) >= 5.0
    assert chart(input=[]) == ""
    html = chart(input=[2.5] * 9, mirror=[0.0])  # what is always the same is a sentence
    assert "<svg" not in html and "always 2.5 m, n = 9" in html and "always 0 m, n = 1" in html
    assert "<svg" in chart(input=[2.5] * 9, mirror=[0.0, 0.1])
    html = chart(input=[2.5] * 99 + [2.0])
    assert "<svg" not in html and "nearly always 2.5 m; 2 m to 2.5 m, n = 100" in html
    assert (amount(45.678, "°"), amount(0.5, "%")) == ("45.7°", "0.5 %")


# ---------------------------------------------------------------------------------------------- sections


def test_sections_say_what_was_asked_made_left_out_and_failed(figures):
    job = Job(name="small", seed=1, scenes=1200)
    html = overview_html(figures, job, 3)
    assert "<dd>3<small>of 1,200 asked</small>" in html and "<dd>3<small>50 % of those tried</small>" in html
    assert "different ones in 2 categories" in html and "chosen evenly" not in html
    assert "chosen evenly" in overview_html(replace(figures, sampled=True), job, 0)
    html = effects_html(figures)
    assert re.search("<code>drop</code></th><td>3<small>100%</small></td><td>1.[23] s</td><td>625 ms</td>", html)
    assert "1 effect that ran in no scene" in html and "<dd>no glass; not asked</dd>" in html
    assert "left out 1 ×: off" in html
    skips = Counter({"it stands": 5, "it is flat": 2, "off": 1})
    html = effects_html(replace(figures, effects={"floor": Cost(3), "tip": Cost(2, 1.0, 2, skips)}))
    assert html.count("<code>floor") == 1 and "left out 5 ×: it stands, 2 more reasons" in html
    html = failures_html(figures.failures, 9)
    assert "left table" in html and "at 0.7 m" in html and "scene 2, 4" in html
    assert failures_html((), 9) == '<p class="empty">No scene failed of 9.</p>'
    html = charts_html(figures, {"input": Histogram(0.0, 9.6)})
    titles = ["Distance to the object", "Visibility", "Inclination"]  # no depth: it has no values
    assert re.findall("<h3>(.*?)</h3>", html) == titles


def test_what_was_drawn_of_the_look_is_counted_and_shown_and_without_a_look_there_is_nothing(figures):
    light = [{"towards": [0.6, 0.0, 0.8]}, {"towards": [0.0, 0.0, 1.0]}]
    drawn = [
        {"environment": "office", "floor": HOSTILE, "lights": light, "clutter": [{}] * 2, "room_m": [6.0, 7.0, 3.0]},
        {"environment": "office", "floor": HOSTILE, "room_m": [8.0, 7.0, 3.0]},
        None,
        {"environment": "overcast", "lights": light[1:], "clutter": []},
        {"environment": "office", "floor": HOSTILE},
    ]
    tables = Handmade(scenes=[{"scene_id": 9 - at, "surroundings": one} for at, one in enumerate(drawn)])
    made = collect(tables)
    assert made.drawn == {
        "Environment": {"office": 3, "overcast": 1},
        "Lights": {"1": 1, "2": 1},
        "Floor": {HOSTILE: 3},
        "Clutter objects": {"0": 1, "2": 1},
    }
    assert (made.room["length"].least, made.room["length"].most, made.room["width"].count) == (6.0, 8.0, 2)
    assert (made.elevation.least, made.elevation.most) == pytest.approx((np.degrees(np.arcsin(0.8)), 90.0))
    assert choose_looks(tables) == [5, 6, 9, 8]  # 5 and 8 were drawn alike
    html = look_html(made, ["<figure>a scene</figure>"])
    assert (
        "<script" not in html and "&lt;script&gt;" in html and html.endswith('"latest"><figure>a scene</figure></div>')
    )
    assert re.findall(r'<rect class="bar" width="([\d.]+)" height="8"', html)[:2] == ["100.0", "33.3"]
    many = replace(made, drawn={"Floor": Counter({f"{at}.png": 1 + (at == 20) for at in range(30)})})
    html = look_html(many, [])
    assert "Floor, the 12 most frequent of 30" in html and html.count("<tr>") == 12 and "20.png</th>" in html
    assert look_html(figures, []) == "" and choose_looks(Handmade(scenes=[{"scene_id": 1}])) == []


def test_what_comes_from_the_dataset_is_text_and_never_markup(figures):
    failure = Failure(HOSTILE, "intrinsic", HOSTILE, 1, (1,), HOSTILE)
    skips = Counter({HOSTILE: 1})
    hostile = replace(
        figures,
        by_category=skips,
        effects={HOSTILE: Cost(1, 0.0, 0, skips), f"{HOSTILE}2": Cost(0, 0.0, 0, skips)},
        stages={HOSTILE: Cost(1, 1.0, 1)},
    )
    overview = overview_html(hostile, Job(name="small", seed=1, scenes=3), 0)
    row = dict.fromkeys(COLUMNS) | {"scene_id": 0, "category": HOSTILE, "name": HOSTILE, "split": "train", "worst": ""}
    table = scene_table_html(SceneTable([row]), HOSTILE)
    for part in (overview, effects_html(hostile), failures_html([failure], 1), table):
        assert "<script" not in part and "&lt;script&gt;" in part
