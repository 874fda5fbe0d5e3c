"""Every hard case for captures: what must hold within its bound, and what must be refused for the reason given."""

import pytest

from schemas.errors import CaptureError
from tests.hard_cases.capture_cases import CAPTURES, HOLD, run


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in CAPTURES])
def test_a_hard_case_for_captures_ends_as_declared(case, tmp_path, record_figure):
    try:
        figure, ended, words = run(case, tmp_path)
    except CaptureError as error:
        figure, ended, words = None, f"must refuse: {error.reason}", error.detail
    record_figure(f"capture: {case.name}", case.outcome, figure, case.bound if case.outcome == HOLD else None)
    assert ended == case.outcome, words
    assert case.words in words
    assert figure is None or figure <= case.bound


def test_no_two_cases_for_captures_have_one_name():
    assert len({case.name for case in CAPTURES}) == len(CAPTURES)
