"""Presets: defaults for several keys at once, chosen from the measurement in docs/tradeoff."""

import copy
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Literal

from schemas.job.keys import set_key

PresetName = Literal["fast", "balanced", "exact"]

PRESETS: dict[PresetName, dict[str, Any]] = {
    "fast": {"physics.step_hz": 240, "render.tier": "flat", "render.samples": 1},
    "balanced": {"physics.step_hz": 960, "render.tier": "raster", "render.samples": 1},
    "exact": {"physics.step_hz": 1920, "render.tier": "raster", "render.samples": 4},
}
"""Values by preset and dotted key; all presets set the same keys. They set effort, and never what is stored (image size,
units, how d_z is read). `balanced` equals the keys' own defaults."""


def with_preset(tree: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a job's keys, with those of its preset where the job does not give them.

    An unknown preset is left to validation; a branch that is no mapping is left as it is.
    """
    filled = copy.deepcopy(dict(tree))
    chosen = next((keys for name, keys in PRESETS.items() if name == filled.get("preset", "balanced")), {})
    for path, value in chosen.items():
        with suppress(ValueError):
            set_key(filled, path, value, keep=True)
    return filled
