"""Errors: each has a name, a unit, and a short name of its own."""

from services.study.model import ERRORS, short


def test_every_error_has_a_short_name():
    assert all(short(name) == kind.short != "" for name, kind in ERRORS.items())
    assert len({kind.short for kind in ERRORS.values()}) == len(ERRORS)


def test_the_unit_is_the_end_of_the_name():
    endings = {name: name.rpartition("_")[2] for name in ERRORS}
    assert all(kind.unit == (endings[name] if endings[name] in ("mm", "deg") else "") for name, kind in ERRORS.items())
