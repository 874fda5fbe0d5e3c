"""Every hard case for recordings: depth within its bound and losses told, or refused for the reason given."""

import pytest

from schemas.errors import CaptureError
from tests.hard_cases.recording_cases import DEPTH_MM, HOLD, RECORDINGS, import_made, worst_table_mm


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in RECORDINGS])
def test_a_hard_case_for_recordings_ends_as_declared(case, record_figure, tmp_path):
    figure, ended, detail = None, HOLD, ""
    try:
        made, out = import_made(case.make(), tmp_path)
        case.told(made)
        figure = worst_table_mm(made, out)
    except CaptureError as error:
        ended, detail = f"must refuse: {error.reason}", error.detail
    record_figure(
        f"{case.name}: depth of the table off, mm", case.outcome, figure, DEPTH_MM if figure is not None else None
    )
    assert ended == case.outcome
    assert figure is None or figure <= DEPTH_MM
    assert not detail or ("recording.mkv" in detail and not list((tmp_path / "capture").iterdir()))


def test_no_two_cases_for_recordings_have_one_name():
    assert len({case.name for case in RECORDINGS}) == len(RECORDINGS)
