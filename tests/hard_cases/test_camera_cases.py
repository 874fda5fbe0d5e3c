"""Every hard case for cameras: what must hold within its bound, and what must be refused for the reason given."""

import pytest

from schemas.errors import SceneError
from tests.hard_cases.camera_cases import CAMERAS, HOLD
from workers.render.raster.gbuffer import shared_renderer


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in CAMERAS])
def test_a_hard_case_for_cameras_ends_as_declared_and_twice_alike(case, record_figure):
    ends: list[tuple[float | None, str]] = []
    for _ in range(2):
        try:
            ends.append((case.figure(shared_renderer()), HOLD))
        except SceneError as error:
            ends.append((None, f"must refuse: {error.reason}"))
    figure, ended = ends[0]
    record_figure(f"{case.name}: {case.what}", case.outcome, figure, case.bound if case.outcome == HOLD else None)
    assert ended == case.outcome
    assert figure is None or figure <= case.bound
    assert ends[0] == ends[1]


def test_no_two_cases_for_cameras_have_one_name():
    assert len({case.name for case in CAMERAS}) == len(CAMERAS)
