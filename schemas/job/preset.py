"""Presets: defaults for several keys at once, chosen from the measurement in docs/tradeoff."""

import copy
from collections.abc import Mapping
from typing import Any, Literal

PresetName = Literal["fast", "balanced", "exact"]

PRESETS: dict[PresetName, dict[str, Any]] = {
    "fast": {"physics.step_hz": 240, "render.tier": "flat", "render.samples": 1},
    "balanced": {"physics.step_hz": 960, "render.tier": "raster", "render.samples": 1},
    "exact": {"physics.step_hz": 1920, "render.tier": "raster", "render.samples": 4},
}
"""By name, the same dotted keys in each: how hard is tried, and never what is stored (image size, units, how d_z is read).
`balanced` is what the keys' own defaults say."""


def with_preset(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of a job with those of its preset where it does not give them itself; unknown presets are left to validation.

    A branch that is not a mapping (a model, or something wrong) is the user's as a whole.
    """
    filled = copy.deepcopy(dict(tree))
    chosen = PRESETS.get(filled.get("preset", "balanced"), {}) if isinstance(filled.get("preset", ""), str) else {}
    for path, value in chosen.items():
        *parents, last = path.split(".")
        place: Any = filled
        for key in parents:
            place = place.setdefault(key, {}) if isinstance(place, dict) else None
        if isinstance(place, dict):
            place.setdefault(last, value)
    return filled
