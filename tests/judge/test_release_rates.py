"""The comparison of release rates tells what one of them lets pass; the releases themselves are made up here."""

import numpy as np
import pytest

from services.job.job_file import validate_job
from tests.judge import release_rates
from tests.judge.release_rates import LIFTS_MM, TILTS_DEG, compare, main
from workers.assets.catalogue import open_catalogue
from workers.geometry.frames import angle_between, transform, translation
from workers.physics.fall import FINEST

JOB = validate_job({"name": "rates", "seed": 2024}, "a test")


def moves(by_mm: dict[float, float], seen: list | None = None):
    """A release in which an object goes up by so much at each rate."""

    def release(plan, placed, physics, effects, seconds, rate):
        if seen is not None:
            seen.append((plan, placed[0].T_world_obj))
        return (translation(0.0, 0.0, by_mm[rate] / 1e3) @ placed[0].T_world_obj,)

    return release


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory):
    return open_catalogue(JOB.assets, tmp_path_factory.mktemp("job"), tuple(JOB.categories))


def test_an_object_is_let_go_from_rest_turned_twice_and_lifted(catalogue, monkeypatch):
    seen = []
    monkeypatch.setattr(release_rates, "release_again", moves({FINEST: 0.0, release_rates.RELEASE_RATE: 0.05}, seen))
    compared = list(compare(JOB, catalogue, 5001))
    assert [one.kind for one in compared] == ["at rest", "turned", "turned", "lifted"]
    assert all(one.refused == (False, False) and one.quarter[0] == pytest.approx(0.05) for one in compared)
    (plan, rest), *others = seen[::2]
    low_m = transform(rest, plan.objects[0].hull.vertices)[:, 2].min()
    for (_, T), degrees, lift_mm in zip(
        others, (TILTS_DEG[1], TILTS_DEG[5], 0.0), (0.0, 0.0, LIFTS_MM[1]), strict=True
    ):
        assert np.degrees(angle_between(rest[:3, :3], T[:3, :3])) == pytest.approx(degrees, abs=1e-4)
        lowest_m = transform(T, plan.objects[0].hull.vertices)[:, 2].min()
        assert lowest_m - low_m == pytest.approx(lift_mm / 1e3, abs=1e-9)


@pytest.mark.parametrize(("finest_mm", "quarter_mm", "code"), [(0.2, 0.2, 0), (0.05, 0.2, 0), (0.2, 0.05, 1)])
def test_only_what_the_quarter_alone_lets_pass_is_an_error(finest_mm, quarter_mm, code, monkeypatch, capsys):
    rates = {FINEST: finest_mm, release_rates.RELEASE_RATE: quarter_mm}
    monkeypatch.setattr(release_rates, "release_again", moves(rates))
    monkeypatch.setattr("sys.argv", ["release_rates", "--scenes", "1"])
    assert main() == code
    rest = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| at rest"))
    both, quarter, finest = finest_mm == quarter_mm, quarter_mm > finest_mm, finest_mm > quarter_mm
    assert rest.startswith(f"| at rest | 2 | {int(both or finest) * 2} | {int(quarter) * 2} | {int(finest) * 2} |")
