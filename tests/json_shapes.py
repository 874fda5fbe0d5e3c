"""Words of JSON Schema, for small schemas of files that somebody else defines."""

from typing import Any

TEXT = {"type": "string"}
TRUTH = {"type": "boolean"}


def closed(*required: str, **properties: Any) -> dict[str, Any]:
    """A map that has these keys and no others; it must have those that are `required`."""
    return {"type": "object", "properties": properties, "required": list(required), "additionalProperties": False}


def each(value: Any) -> dict[str, Any]:
    """A map from names to values of one kind."""
    return {"type": "object", "additionalProperties": value}
