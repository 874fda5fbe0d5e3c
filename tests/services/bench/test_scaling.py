"""What several at once gain over one: through Ray, and as plain processes."""

import pytest

from schemas.dataset.commit import Span
from services.bench.figures import Lap
from services.bench.scaling import gain_of, measure_scaling, plain_processes
from services.job.job_file import validate_job
from tests.services.bench.small_job import SMALL


def test_the_gain_of_several_is_in_pairs_and_its_price_in_processor_time():
    one = [Lap(10, 10.0, 9.0, {}), Lap(10, 20.0, 9.0, {})]
    two = [Lap(10, 6.0, 10.8, {}), Lap(10, 10.0, 9.9, {})]
    gain = gain_of(one, two)
    assert gain["speedup"] == pytest.approx({"median": 11 / 6, "least": 10 / 6, "most": 2.0})
    assert gain["inflation"] == pytest.approx({"median": 1.15, "least": 1.1, "most": 1.2})
    assert (gain["one_scenes_per_s"], gain["all_scenes_per_s"]) == pytest.approx((0.75, (10 / 6 + 1.0) / 2))


@pytest.mark.minute
def test_plain_processes_make_the_same_scenes_at_the_same_time(tmp_path):
    span = Span(start=0, stop=3)
    with plain_processes(validate_job(SMALL, "test"), tmp_path, tmp_path, 2) as processes:
        alone, both = processes.run("alone", 1, span), processes.run("both", 2, span)
        loops = processes.loop(2, 0.2)
    assert [lap.scenes for lap in (*alone, *both)] == [3, 3, 3]
    assert all(lap.cpu_s > 0 for lap in both)
    for number, name in ((0, "alone"), (0, "both"), (1, "both")):
        commits = (tmp_path / f"bare{number}" / name / "manifest" / "_commits").glob("*.json")
        assert sorted(int(path.stem) for path in commits) == [0, 2]
    assert all(lap.scenes > 0 and lap.cpu_s <= lap.wall_s < 1.0 for lap in loops)


@pytest.mark.slow
@pytest.mark.ray
def test_scaling_tells_rays_part_from_the_machines(tmp_path):
    told = measure_scaling(validate_job(SMALL, "test"), tmp_path, tmp_path, workers=2, scenes=8, rounds=1)
    assert told["ray"]["scenes"] == told["bare"]["scenes"] == 8
    assert 0 < told["ray_share_one"]["median"] < 1 and 0 < told["ray_share"]["median"] < 1
    assert all(0.2 < told[name]["inflation"]["median"] < 5 for name in ("ray", "bare"))
    assert 0.5 < told["loops"]["median"] < 2.5
