"""What a run counts, as it is served; how reports add up is in test_coordinator.py."""

from services.run.metrics import Tally
from tests.services.run.test_coordinator import report, span


def test_what_is_served_is_what_was_counted_and_stays_when_the_run_goes_on():
    tally = Tally(asked=12)
    tally.add(report(span(0, 3, {"intrinsic: left_table": 1})).model_copy(update={"seconds": {"settle": 1.5}}))
    before = tally.counts(2)
    tally.add(report(span(4, 3, {"intrinsic: left_table": 1})).model_copy(update={"seconds": {"settle": 2.5}}))
    after = tally.counts(2)
    assert (before.made, before.failed, before.seconds) == (3, {"intrinsic: left_table": 1}, {"settle": 1.5})
    assert (after.made, after.failed, after.seconds) == (6, {"intrinsic: left_table": 2}, {"settle": 4.0})
    assert (after.asked, after.slots) == (12, 2)
