"""Which settings to time for longer: those whose noise in time would change the choice."""

from services.study.model import Row
from services.study.robustness import close_calls
from tests.made_up_studies import row

OWN = row(depth_mm=0.1, penetration_mm=0.01, mirror_mm=1.0)


def names(rows: list[Row]) -> list[str]:
    return [one.setting.name for one in rows]


def test_settings_whose_time_decides_are_told():
    near = [OWN, row("step=1", 0.5, depth_mm=0.3), row("step=2", 0.53, depth_mm=0.05)]
    far = [OWN, row("step=1", 0.5, depth_mm=0.3), row("step=2", 0.6, depth_mm=0.05)]
    assert names(close_calls(near, {"mirror_mm": 1.0})) == ["step=1", "step=2"]
    assert close_calls(far, {"mirror_mm": 1.0}) == []
    assert names(close_calls(far, {"mirror_mm": 1.0}, noise=0.2)) == ["step=1", "step=2"]
