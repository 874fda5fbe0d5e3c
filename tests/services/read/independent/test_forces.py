"""Equilibrium of stored scenes: right forces pass, and each kind of wrong force is told."""

import copy

import pytest

from services.read.independent.derive import check_forces

JOB = {"physics": {"friction": 0.7, "exact_rest": True}, "captures": None}
LOW, HIGH = 2.0 * 9.81, 1.0 * 9.81
UP, DOWN = [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]


def contact(region, point, force, normal=None):
    return {"with_region": region, "point": point, "normal": normal or UP, "force": force}


def scene():
    """A body of 1 kg on one of 2 kg, each held at two points."""
    low = [contact(2, [x, 0.0, 0.0], [0.0, 0.0, (LOW + HIGH) / 2]) for x in (-0.1, 0.1)]
    low += [contact(4, [x, 0.0, 0.2], [0.0, 0.0, -HIGH / 2], DOWN) for x in (-0.05, 0.05)]
    high = [contact(3, [x, 0.0, 0.2], [0.0, 0.0, HIGH / 2]) for x in (-0.05, 0.05)]
    return {
        "scene_id": 7,
        "bodies": [
            {"region_id": 3, "mass_kg": 2.0, "com": [0.0, 0.0, 0.1], "contacts": low},
            {"region_id": 4, "mass_kg": 1.0, "com": [0.0, 0.0, 0.3], "contacts": high},
        ],
    }


def faults(edit=None, job=JOB) -> str:
    row = copy.deepcopy(scene())
    if edit:
        edit(row["bodies"])
    return "; ".join(check_forces(job, row))


def test_a_scene_in_balance_has_no_fault():
    assert faults() == ""


def nothing_below(bodies):
    bodies[1]["contacts"] = []
    bodies[0]["contacts"] = [contact(2, [0.0, 0.0, 0.0], [0.0, 0.0, LOW])]


def too_heavy(bodies):
    bodies[1]["mass_kg"] *= 1.02


def off_its_centre(bodies):
    bodies[1]["com"] = [0.002, 0.0, 0.3]


def a_pull(bodies):
    for one, sign in ((0, 1), (1, -1)):
        for k, share in ((-2, 1.5), (-1, -0.5)):
            bodies[one]["contacts"][k]["force"] = [0.0, 0.0, -sign * share * HIGH]


def sideways(bodies):
    for k, sign in ((0, 1), (1, -1)):
        bodies[0]["contacts"][k]["force"][0] = sign * 0.6 * LOW


def no_reaction(bodies):
    for k in (-2, -1):
        bodies[0]["contacts"][k]["force"] = [0.0, 0.0, -1.0001 * HIGH / 2]


def a_long_normal(bodies):
    bodies[0]["contacts"][0]["normal"] = [0.0, 0.0, 1.001]


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (nothing_below, "region 4: nothing holds it"),
        (too_heavy, "region 4: its contact forces leave 2.0% of its weight over"),
        (off_its_centre, "region 4: its contact forces turn it, by"),
        (a_pull, "a contact pulls"),
        (sideways, "a contact needs more than its friction of 0.49"),
        (no_reaction, "scene 7: region 3 presses region 4 with another force"),
        (a_long_normal, "has not the length 1"),
    ],
)
def test_a_wrong_force_is_told(edit, told):
    assert told in faults(edit)


def test_captures_and_runs_without_exact_rest_have_no_forces_to_check():
    assert faults(nothing_below, {"physics": {"friction": 0.7, "exact_rest": False}, "captures": None}) == ""
    assert faults(nothing_below, {**JOB, "captures": {}}) == ""
