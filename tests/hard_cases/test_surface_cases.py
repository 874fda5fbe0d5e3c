"""Every hard case for what is merged: the cloud within its bound, or refused for the reason given."""

import pytest

from schemas.errors import CaptureError
from tests.hard_cases.surface_cases import HOLD, P95_MM, SURFACES, p95_mm


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in SURFACES])
def test_a_hard_case_for_surfaces_ends_as_declared(case, record_figure):
    figure, ended, detail = None, HOLD, ""
    try:
        figure = p95_mm(case)
    except CaptureError as error:
        ended, detail = f"must refuse: {error.reason}", error.detail
    record_figure(f"{case.name}: cloud off, 95 %, mm", case.outcome, figure, P95_MM if figure is not None else None)
    assert ended == case.outcome, detail
    assert figure is None or figure <= P95_MM
    assert not detail or len(detail) > 40


def test_no_two_cases_for_surfaces_have_one_name():
    assert len({case.name for case in SURFACES}) == len(SURFACES)
