"""What many judged scenes come to: counts and worst figures, as a summary and as the table of docs/rest.md."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.judge.scenes import Outcome, worst_of

APART_MM, BALANCED, STILL_MM, STILL_DEG = 0.01, 0.01, 0.1, 0.1
"""Bounds on overlap and hover, on the unbalanced share of a weight, and on the motion when let go again."""

LEFT = "left_table"

HEAD = "| set | scenes | left the table | refused by reason | accepted of the rest | worst overlap, mm | worst hover, mm | worst unbalanced | over 0.01 mm | over 1 % | over 0.1 % | let go again, mm / deg | in MuJoCo, mm / deg | physics s: median, mean, max |"  # noqa: E501


def is_within(one: Outcome) -> bool:
    """Whether an accepted scene keeps every bound that it was measured against; a refused one does not count."""
    if one.refused:
        return True
    worst = one.worst
    still = (one.moved_mm or 0.0) <= STILL_MM and (one.turned_deg or 0.0) <= STILL_DEG
    return max(worst.overlap_mm, worst.hover_mm) <= APART_MM and worst.unbalanced <= BALANCED and still


def describe(one: Outcome) -> str:
    """A scene that is refused or over a bound, in a line."""
    if one.refused:
        return f"scene {one.scene_id}: refused after {one.seconds:.2f} s: {one.refused}: {one.detail}"
    worst, again = (
        one.worst,
        "" if one.moved_mm is None else f", let go again {one.moved_mm:.4f} mm {one.turned_deg:.4f} deg",
    )
    return (
        f"scene {one.scene_id}: overlap {worst.overlap_mm:.5f} mm, hover {worst.hover_mm:.5f} mm, "
        f"unbalanced {worst.unbalanced:.2%}{again}"
    )


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Counts, shares, worst figures and seconds. `accepted` is of the scenes whose objects stayed on the table."""
    accepted = [one for one in outcomes if not one.refused]
    worst = [one.worst for one in accepted]
    stayed = sum(one.refused != LEFT for one in outcomes)
    stored = [one.stored for one in accepted if one.stored is not None]
    parts = sorted({name for one in outcomes for name in one.parts_s})
    return {
        "scenes": len(outcomes),
        "left_table": len(outcomes) - stayed,
        "refused": dict(Counter(one.refused for one in outcomes if one.refused and one.refused != LEFT)),
        "accepted": len(accepted) / stayed if stayed else 0.0,
        "worst": worst_of(worst).__dict__ if worst else None,
        "stored": worst_of(stored).__dict__ if stored else None,
        "over_0.01_mm": sum(max(one.overlap_mm, one.hover_mm) > APART_MM for one in worst),
        "over_1_percent": sum(one.unbalanced > BALANCED for one in worst),
        "over_0.1_percent": sum(one.unbalanced > BALANCED / 10 for one in worst),
        "let_go_again": _greatest(accepted, "moved_mm", "turned_deg"),
        "mujoco": _greatest(accepted, "mujoco_mm", "mujoco_deg"),
        "physics_s": _times([one.seconds for one in outcomes]),
        "parts_s": {name: _times([one.parts_s.get(name, 0.0) for one in outcomes]) for name in parts},
        "judge_s": _times([one.judge_s for one in accepted]),
    }


def tabulate(name: str, outcomes: Sequence[Outcome]) -> str:
    """The table's head and its one row, and the times of parts below."""
    found = summary(outcomes)
    refused = ", ".join(f"{count} {reason}" for reason, count in found["refused"].items()) or "none"
    worst = found["worst"] or dict.fromkeys(("overlap_mm", "hover_mm", "unbalanced"), float("nan"))
    cells = [
        name,
        str(found["scenes"]),
        str(found["left_table"]),
        refused,
        f"{found['accepted']:.1%}",
        f"{worst['overlap_mm']:.5f}",
        f"{worst['hover_mm']:.5f}",
        f"{worst['unbalanced']:.2%}",
        *(str(found[key]) for key in ("over_0.01_mm", "over_1_percent", "over_0.1_percent")),
        *(" / ".join(f"{x:.4f}" for x in found[key]) or "not asked" for key in ("let_go_again", "mujoco")),
        _in_words(found["physics_s"]),
    ]
    parts = [f"{part}: {_in_words(times)} s" for part, times in found["parts_s"].items()]
    below = [*parts, f"judge: {_in_words(found['judge_s'])} s"]
    rule = "|" + "---|" * HEAD.count(" | ") + "---|"
    return "\n".join(
        [HEAD, rule, "| " + " | ".join(cells) + " |", "", "median, mean, max of a scene: " + "; ".join(below)]
    )


def _greatest(outcomes: Sequence[Outcome], *names: str) -> list[float]:
    """The greatest of each figure over the scenes that have it; empty without any."""
    found = [[getattr(one, name) for one in outcomes if getattr(one, name) is not None] for name in names]
    return [max(values) for values in found if values]


def _times(seconds: Sequence[float]) -> list[float]:
    """Median, mean and greatest."""
    return [float(np.median(seconds)), float(np.mean(seconds)), max(seconds)] if seconds else [0.0] * 3


def _in_words(times: Sequence[float]) -> str:
    return ", ".join(f"{x:.3g}" for x in times)
