import pytest

from services.cli.parser import build_parser


def test_a_report_takes_pictures_of_24_scenes_unless_told_otherwise():
    options = build_parser().parse_args(["report", "data/tabletop"])
    assert (options.out, options.file, options.scenes) == ("data/tabletop", None, 24)


def test_a_report_of_no_scenes_is_refused(capsys):
    with pytest.raises(SystemExit):
        build_parser().parse_args(["report", "data/tabletop", "--scenes", "0"])
    assert "0 is not a whole number from 1 up" in capsys.readouterr().err
