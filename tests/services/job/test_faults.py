"""Faults of a job file are told without names of classes, patterns and validators."""

import pytest
from pydantic import ValidationError

from schemas.job.job import Job
from services.job.job_file import describe_fault


def told(**keys) -> list[str]:
    with pytest.raises(ValidationError) as refusal:
        Job.model_validate({"name": "t", **keys})
    return [describe_fault(fault) for fault in refusal.value.errors()]


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"name": "a b"}, "name: 'a b': a name is 1 to 64 letters, digits, ., - and _"),
        ({"physics": 3}, "physics: 3: must hold keys with values"),
        ({"assets": {"objects": 3}}, "assets.objects: 3: must be a list"),
        ({"assets": {"objects": [3]}}, "assets.objects.0: 3: must hold keys with values"),
        ({"assets": {"objects": [{}]}}, "assets.objects.0: {}: must have a key 'source'"),
        ({"assets": {"objects": [{"source": "urd"}]}}, "its 'source' did you mean 'urdf'? must be 'procedural', "),
        ({"start": {"offset_m": 3}}, "start.offset_m: 3: must be two numbers: [low, high]"),
        ({"start": {"offset_m": [3]}}, "start.offset_m.1: is missing"),
        ({"start": {"offset_m": [1, 2, 3]}}, "start.offset_m: [1, 2, 3]: must have at most 2 of them"),
        (
            {"start": {"pose": "uprigth"}},
            "start.pose: 'uprigth': did you mean 'upright'? must be 'upright', 'tumbled' or",
        ),
        ({"scenes": "x"}, "scenes: 'x': must be a whole number"),
        ({"scenes": 2.5}, "scenes: 2.5: must be a whole number"),
        ({"scenes": 0}, "scenes: 0: must be at least 1"),
        ({"categories": []}, "categories: {}: must have at least 1 of them"),
        ({"check": {"raycast_share": 2}}, "check.raycast_share: 2: must be at most 1"),
        ({"check": {"raycast_share": "half"}}, "check.raycast_share: 'half': must be a number"),
        ({"physics": {"exact_rest": "maybe"}}, "physics.exact_rest: 'maybe': must be true or false"),
        ({"phisics": 1}, "phisics: there is no such key; did you mean 'physics'?"),
    ],
)
def test_a_fault_is_one_line_of_plain_words(keys, words):
    lines = told(**keys)
    assert any(line.startswith(words) or words in line for line in lines), lines
    for line in lines:
        assert "\n" not in line
        for jargon in ("pattern", "dictionary", "instance of", "tuple", "discriminator", "Input", "parse"):
            assert jargon not in line
