import re

import numpy as np
import pytest

from services.look.charts import HEIGHT, Chart, Histogram, amount, chart_html, length_of_decade


def metres(value: float) -> str:
    return amount(value, "m")


def test_bars_are_as_high_as_their_counts():
    values = np.repeat([1.0, 2.0, 4.0], [10, 5, 20])
    html = chart_html(Chart("Depth", {"": Histogram(0.0, 9.6).add(values)}, "Of pixels.", metres))
    heights = [float(height) for height in re.findall(r'height="([\d.]+)"><title>', html)]
    assert [height / max(heights) for height in heights] == pytest.approx([0.5, 0.25, 1.0], abs=0.005)
    assert max(heights) < HEIGHT
    assert re.findall(r": (\d+)</title>", html) == ["10", "5", "20"]


def test_the_figure_says_median_spread_and_number_to_those_who_do_not_see_it():
    values = np.linspace(1.0, 3.0, 2001)
    html = chart_html(Chart("Depth", {"input": Histogram(0.0, 9.6).add(values)}, "Of pixels.", metres))
    assert 'aria-label="Depth. input: median 2' in html
    assert "n = 2,001" in html


def test_a_second_series_is_a_line_over_the_same_axis():
    one, other = Histogram(0.0, 9.6).add([1.0, 1.1]), Histogram(0.0, 9.6).add([5.0])
    html = chart_html(Chart("Depth", {"input": one, "mirror": other}, "Of pixels.", metres))
    assert html.count('<path class="line"') == 1
    first, _, last = re.findall(r"<span>([\d.]+) m</span>", html)
    assert float(first) <= 1.0 and float(last) >= 5.0


def test_there_is_no_figure_without_values():
    assert chart_html(Chart("Depth", {"input": Histogram(0.0, 1.0)}, "Of pixels.", metres)) == ""


@pytest.mark.parametrize(
    ("decade", "words"),
    [(-6.0, "1 nm"), (-4.5, "31.6 nm"), (-2.0, "10 µm"), (0.0, "1 mm"), (3.0, "1 m"), (-3.0, "1 µm")],
)
def test_a_power_of_ten_is_told_as_a_length(decade, words):
    assert length_of_decade(decade) == words


def test_a_degree_sign_stands_at_its_number():
    assert (amount(45.678, "°"), amount(0.5, "%")) == ("45.7°", "0.5 %")
