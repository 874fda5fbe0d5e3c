"""A folder that vanished is told as that, whatever error it led to; any other error stays what it is."""

import pytest

from schemas.errors import MachineError, RunError
from services.run.lock import explain_lost_folder


@pytest.mark.parametrize("error", [RunError("swept: another coordinator works on this folder"), FileNotFoundError("x")])
@pytest.mark.parametrize("made_anew", [False, True])
def test_a_removed_folder_is_told_even_where_parts_of_it_were_made_anew(tmp_path, error, made_anew):
    out = tmp_path / "out"
    out.mkdir()

    def work() -> None:
        out.rmdir()
        if made_anew:
            (out / "manifest").mkdir(parents=True)
        raise error

    with (
        pytest.raises(MachineError, match="was removed while the run worked in it") as caught,
        explain_lost_folder(out),
    ):
        work()
    assert str(out) in str(caught.value)
    assert "another coordinator" not in str(caught.value)


def test_a_folder_that_was_moved_is_told_with_what_to_do(tmp_path):
    out = tmp_path / "out"
    out.mkdir()

    def work() -> None:
        out.rename(tmp_path / "elsewhere")
        raise FileNotFoundError("x")

    with pytest.raises(MachineError, match=r"was moved .* move it back"), explain_lost_folder(out):
        work()


def test_other_errors_stay_what_they_are(tmp_path):
    with pytest.raises(RunError, match="as it was"), explain_lost_folder(tmp_path):
        raise RunError("as it was")
    with pytest.raises(RunError, match="in a bucket"), explain_lost_folder(None):
        raise RunError("in a bucket")
