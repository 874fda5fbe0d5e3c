"""Reads back the `study.json` of a study."""

import json
from pathlib import Path

from services.study.model import Figure, Row, Setting, Study
from services.study.page import STUDY_FILE, STUDY_VERSION


def read_study(folder: Path) -> Study:
    """What `write_tables` was given; a tuple among the values of changes or machine comes back as a list."""
    tree = json.loads((folder / STUDY_FILE).read_text(encoding="utf-8"))
    assert tree.pop("verso_study") == STUDY_VERSION
    return Study(**(tree | {"rows": tuple(map(_row, tree["rows"])), "notes": tuple(tree["notes"])}))


def _row(tree: dict) -> Row:
    setting = Setting(tuple((knob, label) for knob, label in tree["setting"]["parts"]), tree["setting"]["changes"])
    errors = {name: Figure(**figure) for name, figure in tree["errors"].items()}
    return Row(**(tree | {"setting": setting, "errors": errors, "notes": tuple(tree["notes"])}))
