"""Settings: named by their parts, and told apart by how many knobs they turn."""

import pytest

from services.study.model import Setting


@pytest.mark.parametrize(
    ("parts", "name", "kind"),
    [
        ((), "the job", "own"),
        ((("preset", "fast"),), "preset=fast", "preset"),
        ((("step", "240"),), "step=240", "single"),
        ((("step", "240"), ("tier", "flat")), "step=240, tier=flat", "several"),
    ],
)
def test_a_setting_is_named_by_its_parts(parts, name, kind):
    setting = Setting(parts)
    assert (setting.name, setting.kind) == (name, kind)
