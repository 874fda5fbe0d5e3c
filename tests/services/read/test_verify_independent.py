"""The second derivation, as a command uses it; its formulas are tested in tests/services/read/independent."""

from services.read.audit import describe_independent, verify_independently


def test_some_scenes_are_derived_and_counted(tiny):
    found = verify_independently(tiny, 2, lambda _: None)
    assert (found.scenes, found.pairs, found.faults) == (2, 2, [])
    assert "nothing off" in next(describe_independent(found))
