"""What several at once gain over one: through Ray, and as plain processes."""

import pytest

from services.bench.bare import bare_processes
from services.bench.ratios import Lap, Spread
from services.bench.scaling import Gain, measure_scaling
from services.job.read import validate_job

SMALL = {
    "name": "small",
    "seed": 5,
    "cameras": {"sensor": {"width": 160, "height": 120, "fx": 131.25, "fy": 131.25, "cx": 80.0, "cy": 60.0}},
    "images": {"patch": {"width": 32, "height": 24}},
    "check": {"raycast_share": 0.0, "mirror_agreement_mm": 5.0},
    "run": {"range_size": 2},
}


def test_the_gain_of_several_is_in_pairs_and_its_price_in_processor_time():
    one = [Lap(10, 10.0, 9.0, {}), Lap(10, 20.0, 9.0, {})]
    two = [Lap(10, 6.0, 10.8, {}), Lap(10, 10.0, 9.9, {})]
    gain = Gain.of(one, two)
    assert gain.speedup == Spread(pytest.approx(11 / 6), pytest.approx(10 / 6), 2.0)
    assert gain.inflation == Spread(pytest.approx(1.15), pytest.approx(1.1), pytest.approx(1.2))
    assert (gain.one_scenes_per_s, gain.all_scenes_per_s) == pytest.approx((0.75, (10 / 6 + 1.0) / 2))


def test_plain_processes_make_the_same_scenes_at_the_same_time(tmp_path):
    with bare_processes(validate_job(SMALL, "test"), tmp_path, tmp_path, 2) as processes:
        alone, both = processes.run(1, 0, 3), processes.run(2, 0, 3)
    assert [lap.scenes for lap in (*alone, *both)] == [3, 3, 3]
    assert all(lap.cpu_s > 0 for lap in both)
    for number, last in ((0, 2), (1, 1)):  # folder 0 is the warm-up's
        commits = (tmp_path / f"bare{number}" / str(last) / "manifest" / "_commits").glob("*.json")
        assert sorted(int(path.stem) for path in commits) == [0, 2]


@pytest.mark.slow
@pytest.mark.ray
def test_scaling_tells_rays_part_from_the_machines(tmp_path):
    told = measure_scaling(validate_job(SMALL, "test"), tmp_path, tmp_path, workers=2, scenes=8, rounds=1, shard=2)
    assert told.ray.scenes == told.bare.scenes == 8
    assert 0 < told.ray_share_one.median < 1 and 0 < told.ray_share.median < 1
    assert 0.2 < told.ray.inflation.median < 5 and 0.2 < told.bare.inflation.median < 5
