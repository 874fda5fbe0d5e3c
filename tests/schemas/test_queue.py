import re

import pytest
from pydantic import ValidationError

from schemas.queue import ID_PATTERN, SUBMISSION_PATTERN, JobEvent, submission_id
from services.cli.arguments import JOB_ID

NONCE = "0" * 32


def test_the_parser_and_the_files_agree_on_what_an_id_is():
    assert f"^{JOB_ID}$" == ID_PATTERN


def test_a_submission_id_holds_nothing_that_a_shell_or_a_url_reads():
    assert re.match(SUBMISSION_PATTERN, submission_id("j0a1b2c3d", 12))


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "ended", "attempt": 1},
        {"kind": "died", "attempt": 1, "code": 1},
        {"kind": "cancel", "attempt": 1},
        {"kind": "started"},
        {"kind": "flew", "attempt": 1},
        {"kind": "died", "attempt": 1, "note": "two\nlines"},
    ],
)
def test_an_event_that_means_nothing_is_refused(wrong):
    with pytest.raises(ValidationError):
        JobEvent(at=0.0, nonce=NONCE, **wrong)
