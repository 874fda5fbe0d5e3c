"""The knobs of captures that the study turns. Pure."""

from collections.abc import Iterable

from schemas.job.captures import ESTIMATES, Captures
from services.study.model import Knob, Value

VIEWS = (4, 6, 10, 20, 40)
"""Numbers of views, as far as the job's captures have as many."""


def capture_knobs(captures: Captures) -> tuple[Knob, ...]:
    """Every knob of a job of simulated captures, from coarse to fine where its values have an order.

    `markers` and `article` estimate each view by itself, `joint` all together.
    """
    knobs = {
        "views": _values("captures.simulate.views", (n for n in VIEWS if n < captures.simulate.views)),
        "estimate": [Value(name, {"captures.estimation.estimate": name}) for name in ESTIMATES],
        "iterations": _values("captures.estimation.max_iterations", (1, 2, 5, 20)),
        "voxel": _values("captures.fusion.voxel_m", (0.006, 0.004, 0.002, 0.0015)),
        "merged_views": _values("captures.synthesis.views", (1, 3, 6, 12)),
    }
    return tuple(Knob(name, "capture", tuple(values)) for name, values in knobs.items())


def _values(key: str, values: Iterable[float]) -> list[Value]:
    return [Value(f"{value:g}", {key: value}) for value in values]
