"""Faults of a job file in plain words: the key, its value, and what is allowed. Pure."""

from collections.abc import Mapping, Sequence
from typing import Any

from schemas.errors import did_you_mean, plain_line
from services.job.reference import allowed_keys

_KEYS, _NUMBER, _WHOLE, _TEXT = (
    "must hold keys with values",
    "must be a number",
    "must be a whole number",
    "must be text: write it in quotes",
)

_WORDS: Mapping[str, str] = {
    "model_type": _KEYS,
    "model_attributes_type": _KEYS,
    "dict_type": _KEYS,
    "list_type": "must be a list: [a, b]",
    "tuple_type": "must be a list: [a, b]",
    "named_tuple_type": "must be two numbers: [low, high]",
    "int_type": _WHOLE,
    "int_parsing": _WHOLE,
    "int_from_float": _WHOLE,
    "float_type": _NUMBER,
    "float_parsing": _NUMBER,
    "finite_number": "must be a finite number",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "string_type": _TEXT,
}
"""By the validator's kind of fault, in place of its own words, which name classes."""

_COUNTS = {"too_short": "at least", "too_long": "at most"}

_BOUNDS: Mapping[str, tuple[str, str]] = {
    "greater_than_equal": ("ge", "must be at least"),
    "greater_than": ("gt", "must be greater than"),
    "less_than_equal": ("le", "must be at most"),
    "less_than": ("lt", "must be less than"),
}


def describe_fault(fault: Any) -> str:
    """One line on a fault as pydantic tells it: the key's path, its value, and what is allowed."""
    words = [plain_line(str(part)) for part in _written(fault["loc"])]
    key = plain_line(".".join(words), 200)
    if fault["type"] == "extra_forbidden":
        allowed = allowed_keys(words)
        return f"{key}: there is no such key; {did_you_mean(words[-1], allowed)}Allowed here: {', '.join(allowed) or 'nothing'}"
    if fault["type"] == "missing":
        return (
            f"{key}: is missing, and has no default" if not key.rpartition(".")[2].isdigit() else f"{key}: is missing"
        )
    message = plain_line(_message(fault), 300)
    if not words:
        return message  # of several keys, which it names
    return f"{key}: {plain_line(repr(fault['input']))}: {message[:1].lower()}{message[1:]}"


def _message(fault: Any) -> str:
    kind, context = fault["type"], fault.get("ctx", {})
    if kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        return f"{words} {context[name]:g}"
    if kind == "union_tag_not_found":
        return f"must have a key {context['discriminator']}"
    if kind == "union_tag_invalid":
        return f"its {context['discriminator']} {_one_of(context['tag'], context['expected_tags'])}"
    if kind == "literal_error":
        return _one_of(fault["input"], context["expected"])
    if kind in ("too_short", "too_long"):
        return f"must have {_COUNTS[kind]} {context['min_length' if kind == 'too_short' else 'max_length']} of them"
    return str(_WORDS.get(kind, fault["msg"].removeprefix("Value error, ")))


def _one_of(given: object, allowed: str) -> str:
    """`allowed` as pydantic lists it: 'a', 'b' or 'c'."""
    known = [word.strip("'") for word in allowed.replace(" or ", ", ").split(", ")]
    return f"{did_you_mean(str(given), known)}must be {allowed}"


def _written(place: Sequence[str | int]) -> list[str | int]:
    """The parts of a place that the job file has: not the kind that follows a source's position, nor the mark of a key."""
    parts = [part for before, part in zip((None, *place), place, strict=False) if not isinstance(before, int)]
    return parts[:-1] if parts[-1:] == ["[key]"] else parts
