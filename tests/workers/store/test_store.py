import pytest

from workers.store.store import retry_if_swept


@pytest.mark.parametrize("losses", [0, 1, 2])
def test_a_step_whose_file_was_swept_is_tried_again(losses):
    left = [FileNotFoundError()] * losses

    def step():
        if left:
            raise left.pop()
        return "done"

    assert retry_if_swept(step) == "done"


def test_a_step_that_fails_each_time_is_given_up_after_three_calls():
    calls = []

    def step():
        calls.append(1)
        raise FileNotFoundError

    with pytest.raises(FileNotFoundError):
        retry_if_swept(step)
    assert len(calls) == 3
