from schemas.job.captures import ESTIMATES, Captures, Simulate
from schemas.job.job import Job
from services.study.knobs import apply, capture_knobs, knobs_of, settings_of


def test_every_value_makes_a_job_that_differs_from_the_jobs_own():
    job = Job.model_validate({"name": "t", "scenes": 2, "captures": {"simulate": {"views": 24}}})
    settings, left_out = settings_of(job, knobs_of(job))
    assert left_out == ()
    own = apply(job, settings[0].changes)
    assert all(apply(job, one.changes) != own for one in settings[1:])


def test_there_are_no_more_views_than_the_captures_have():
    knobs = {knob.name: knob for knob in capture_knobs(Captures(simulate=Simulate(views=12)))}
    assert [value.label for value in knobs["views"].values] == ["4", "6", "10"]
    assert [value.label for value in knobs["estimate"].values] == list(ESTIMATES)
