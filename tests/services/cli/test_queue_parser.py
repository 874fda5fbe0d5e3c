import pytest

from services.cli.parser import build_parser


@pytest.mark.parametrize(
    "words",
    [
        ["logs", "../../etc"],
        ["cancel", "j0a1b2c3"],
        ["cancel", "J0A1B2C3D"],
        ["logs", "$(touch x)"],
        ["submit", "j.yaml", "--priority", "high"],
        ["submit", "j.yaml", "--priority", "1001"],
        ["supervise", "--at-once", "0"],
        ["supervise", "--address", "127.0.0.1:8265"],
        ["supervise", "--address", "http://user:secret@host:8265"],
        ["drive", "j0a1b2c3d", "0"],
    ],
)
def test_a_word_that_cannot_be_is_refused(words, capsys):
    with pytest.raises(SystemExit) as caught:
        build_parser().parse_args(words)
    assert caught.value.code == 2
    told = capsys.readouterr().err
    assert told.splitlines()[-1].startswith(f"verso {words[0]}: error: argument")


def test_a_priority_may_be_below_zero():
    assert build_parser().parse_args(["submit", "j.yaml", "--priority", "-5"]).priority == -5
