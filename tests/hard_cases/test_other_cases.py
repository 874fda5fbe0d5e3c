"""Every hard case for cameras, captures, recordings and surfaces: what holds within its bound, or is refused for its reason."""

import pytest

from schemas.errors import CaptureError, SceneError
from tests.hard_cases import capture_cases, recording_cases
from tests.hard_cases.camera_cases import CAMERAS, HOLD
from tests.hard_cases.capture_cases import CAPTURES
from tests.hard_cases.recording_cases import DEPTH_MM, RECORDINGS
from tests.hard_cases.surface_cases import P95_MM, SURFACES, p95_mm
from workers.render.raster.gbuffer import shared_renderer

OF_SECONDS = {
    *("a shiny half without depth", "a shiny spot without depth that moves with the camera"),
    *("a transparent sphere in front of a box", "no depth on half of the board", "board at 80 degrees"),
    *(
        "print seen in a mirror",
        "wrong dictionary",
        "wrong board",
        "frontal board",
        "small marker",
        "three markers in one view",
    ),
    *("no depth on the object", "no depth on the board at all", "an object of 4 mm", "no depth on the markers"),
    *("an object of 4 mm below a clearance of 6 mm", "one marker in every view", "one view out of focus"),
    *("over-exposed, white at 255", "all views a little out of focus", "no depth anywhere"),
}
"""Cases that take longest, of which the default suite has one or two of each kind."""


def rows(cases):
    assert len({case.name for case in cases}) == len(cases)
    marked = [
        pytest.param(case, id=case.name, marks=[pytest.mark.minute] * (case.name in OF_SECONDS)) for case in cases
    ]
    return pytest.mark.parametrize("case", marked)


@rows(CAMERAS)
def test_a_hard_case_for_cameras_ends_as_declared_and_twice_alike(case, record_figure):
    ends: list[tuple[float | None, str]] = []
    for _ in range(2):
        try:
            ends.append((case.figure(shared_renderer()), HOLD))
        except SceneError as error:
            ends.append((None, f"must refuse: {error.reason}"))
    figure, ended = ends[0]
    record_figure(f"{case.name}: {case.what}", case.outcome, figure, case.bound if case.outcome == HOLD else None)
    assert ended == case.outcome and ends[0] == ends[1]
    assert figure is None or figure <= case.bound


@rows(CAPTURES)
def test_a_hard_case_for_captures_ends_as_declared(case, tmp_path, record_figure):
    try:
        figure, ended, words = capture_cases.run(case, tmp_path)
    except CaptureError as error:
        figure, ended, words = None, f"must refuse: {error.reason}", error.detail
    record_figure(f"capture: {case.name}", case.outcome, figure, case.bound if case.outcome == HOLD else None)
    assert ended == case.outcome, words
    assert case.words in words
    assert figure is None or figure <= case.bound


@rows(RECORDINGS)
def test_a_hard_case_for_recordings_ends_as_declared(case, record_figure, tmp_path):
    """Depth is within its bound and losses are told; what is refused is named, and nothing is left of it."""
    figure, ended, detail = None, HOLD, ""
    try:
        figure = recording_cases.worst_table_mm(case, tmp_path)
    except CaptureError as error:
        ended, detail = f"must refuse: {error.reason}", error.detail
    bound = DEPTH_MM if figure is not None else None
    record_figure(f"{case.name}: depth of the table off, mm", case.outcome, figure, bound)
    assert ended == case.outcome
    assert figure is None or figure <= DEPTH_MM
    assert not detail or ("recording.mkv" in detail and not list((tmp_path / "capture").iterdir()))


@rows(SURFACES)
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
