"""The gate that every object at rest must pass, by the independent judge."""

from collections.abc import Sequence

from schemas.job.physics import Physics
from schemas.scene.scene import Settled
from tests.hard_cases.measures import Made
from tests.judge.judge import Verdict, judge
from tests.judge.scenes import frictions_of, things_at_rest

GAP_MM = 0.01
"""Of overlap and hover, of whatever rests, on whatever it rests."""

UNBALANCED = 0.01
"""Share of a weight that contacts may leave without balance."""


def verdicts(made: Made, rest: Sequence[Settled], physics: Physics) -> tuple[Verdict, ...]:
    """The judge's on each object."""
    return judge(things_at_rest(made.starts, rest), made.table.mesh, frictions_of(made.starts, physics))


def what_is_wrong(found: Sequence[Verdict]) -> str:
    """What the gate must refuse, with the worst figures; empty where all is well."""
    overlap, hover = max(each.overlap_mm for each in found), max(each.hover_mm for each in found)
    unbalanced = max(each.unbalanced for each in found)
    said = [
        f"{overlap:.3f} mm of overlap" if overlap > GAP_MM else "",
        f"{hover:.3f} mm of hover" if hover > GAP_MM else "",
        f"{unbalanced:.0%} of a weight on nothing" if unbalanced > UNBALANCED else "",
    ]
    return ", ".join(filter(None, said))
