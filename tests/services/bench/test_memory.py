"""Memory and pace of one worker, from samples that were made up."""

import pytest

from services.bench.scaling import Sample, summarise


def test_memory_is_compared_after_it_settled():
    samples = [Sample(16, 100.0 + n, 0.1) for n in range(13)]
    samples += [Sample(16, 120.0, 0.2)] * 100 + [Sample(7, 117.6, 0.11)] * 13
    told = summarise(samples, peak_mb=130.0)
    assert told["scenes"] == 113 * 16 + 13 * 7
    # 192: the end of the first range that holds a tenth of them
    assert (told["settled_after"], told["settled_mb"], told["last_mb"], told["peak_mb"]) == (192, 111.0, 117.6, 130.0)
    assert told["grown"] == pytest.approx(117.6 / 111.0 - 1.0)
    assert (told["first_ms"], told["last_ms"]) == pytest.approx((100.0, 110.0))
    assert told["last_to_first"] == pytest.approx(1.1)


def test_two_thousand_scenes_settle_after_two_hundred():
    told = summarise([Sample(16, 100.0, 0.1)] * 125, peak_mb=100.0)
    assert (told["scenes"], told["settled_after"]) == (2000, 208)
