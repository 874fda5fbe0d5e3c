"""What `verso jobs` shows."""

import pytest

from schemas.errors import CorruptError
from services.queue.listing import format_rows, list_jobs
from tests.datasets import make_dataset
from tests.kit.queue_world import ids, queue_of, request_of

A, B, C, D = ids(4)


def test_a_row_for_each_job_in_the_order_of_its_turn(tmp_path):
    made, _ = make_dataset(tmp_path / "made")
    queue = queue_of(
        tmp_path / "q",
        request_of(A, submitted=1.0, scenes=2),
        request_of(B, submitted=2.0, out=made.name, scenes=9),
        request_of(C, submitted=3.0, priority=5),
        request_of(D, submitted=4.0, out=made.name, priority=1),
    )
    for job in (A, B):
        queue.append(job, "started", 1)
        queue.append(job, "began", 1)
    queue.append(A, "ended", 1, code=1, note="50 % of the scenes failed", scenes=2)
    rows = list_jobs(queue, 64.0)
    assert [(row.id, row.state, row.attempts, row.scenes_done, row.scenes_asked, row.age_s) for row in rows] == [
        (B, "running", 1, 2, 9, 62.0),
        (C, "queued", 0, 0, 8, 61.0),
        (D, "waiting", 0, 0, 8, 60.0),
        (A, "failed", 1, 2, 2, 63.0),
    ]
    lines = format_rows(rows)
    assert lines[0].split() == ["id", "name", "priority", "state", "attempts", "scenes", "age", "out"]
    assert lines[1].split() == [B, "mugs", "0", "running", "1", "2/9", "1", "min", made.name]
    assert "waiting for its folder" in lines[3]
    assert lines[5] == "    50 % of the scenes failed"


def test_a_damaged_job_has_a_row_that_says_so(tmp_path):
    queue = queue_of(tmp_path / "q", request_of(A))
    queue.store.put(f"jobs/{A}/request.json", b"{")
    (row,) = list_jobs(queue)
    assert (row.id, row.state) == (A, "unreadable")
    with pytest.raises(CorruptError):
        queue.read(A)
