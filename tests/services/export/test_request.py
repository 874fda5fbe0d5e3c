from services.cli.rows import EXPORT_FORMATS
from services.export.formats import FORMATS, SHARDED


def test_the_command_line_names_every_format():
    assert EXPORT_FORMATS == FORMATS
    assert set(SHARDED) <= set(FORMATS)
