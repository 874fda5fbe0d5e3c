import argparse
import json

import pytest

from services.cli import doctor
from services.cli.doctor import Finding


@pytest.mark.parametrize(("suffices", "code"), [(True, 0), (False, 1)])
def test_a_missing_part_is_told_with_its_remedy_and_exits_1(monkeypatch, capsys, suffices, code):
    for name in ("_python", "_cores", "_memory", "_disk", "_shared_memory", "_ray", "_stack"):
        monkeypatch.setattr(doctor, name, lambda name=name: Finding(name, True, "there"))
    monkeypatch.setattr(doctor, "_renderer", lambda: Finding("GL", suffices, "found", "install it"))
    assert doctor.main(argparse.Namespace(json=True)) == code
    lines = capsys.readouterr().out.splitlines()
    assert any("install it" in line for line in lines[:-1]) is not suffices
    answer = json.loads(lines[-1])
    assert answer["ok"] is suffices and len(answer["findings"]) == 8
