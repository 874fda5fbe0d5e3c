"""Commands of the launcher, where it was not the launcher that was started."""

import pytest

from services.cli.main import main


@pytest.mark.parametrize(
    ("words", "told"), [(["extra", "audit"], "pip install 'verso-data[audit]'"), (["lock"], "type ./verso lock there")]
)
def test_the_launcher_is_named(words, told, capsys):
    assert main(words) == 2
    assert told in capsys.readouterr().err
