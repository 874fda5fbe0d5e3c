from schemas.capture import CaptureEstimate, Estimates, ViewEstimate


def view(number: int, px: float) -> ViewEstimate:
    return ViewEstimate(number, "used", None, None, 30, px, None)


def test_views_by_markers_are_found_by_number_where_that_estimate_was_made():
    markers = CaptureEstimate("markers", (view(0, 0.5), view(4, 0.7)))
    joint = CaptureEstimate("joint", (view(0, 0.2), view(4, 0.3)))
    both = Estimates("joint", {"markers": markers, "joint": joint}, ())
    assert both.estimate is joint
    assert {number: one.reprojection_px for number, one in both.by_markers.items()} == {0: 0.5, 4: 0.7}
    assert Estimates("joint", {"joint": joint}, ()).by_markers == {}
