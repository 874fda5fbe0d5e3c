"""A YAML text as plain values, bounded: what it costs to read does not depend on who wrote it.

The events of the text are counted before anything is built from them. Aliases, by which 200 bytes stand for 10^9 values, and
tags, which build objects, are refused. So are numbers too long for any key. Dates are text, and `<<` is a key like others.
"""

from dataclasses import dataclass
from typing import Any

import yaml

from schemas.errors import JobError, plain_line

MOST_CHARACTERS = 1_000_000
"""Longest text. A job file may have a quarter, because filling in defaults makes it longer."""

MOST_VALUES = 40_000
"""Most keys and values of a text. The models name about 200 keys; the rest is for lists of sources and patterns."""

MOST_LEVELS = 32
"""Deepest nesting; the models nest 5 levels."""

MOST_NUMBER_CHARACTERS = 64
"""Longest number. Shortest doubles have up to 25 characters."""

_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_LEFT_OUT = {f"tag:yaml.org,2002:{name}" for name in ("timestamp", "merge", "value")}

_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _StrictLoader(_Base):
    """YAML's safe loader that refuses a key written twice, where its own keeps the last, and reads a date as text."""


_StrictLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _LEFT_OUT]
    for first, resolvers in _Base.yaml_implicit_resolvers.items()
}


def _mapping(loader: Any, node: yaml.MappingNode) -> dict[str, Any]:
    built: dict[str, Any] = {}
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, deep=True)
        line = _line_of(key_node)
        if not isinstance(key, str):
            raise JobError(f"line {line}: the key {plain_line(repr(key), 40)} is not a word")
        if key in built:
            raise JobError(f"line {line}: the key '{plain_line(key, 40)}' is written twice")
        built[key] = loader.construct_object(value_node, deep=True)
    return built


_StrictLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)
_RESOLVER = _StrictLoader("")


def parse_yaml(text: str, most_values: int = MOST_VALUES) -> Any:
    """The value that a YAML text holds: None, or maps with text keys, lists, text, numbers and truth values.

    Takes below a second and 100 MB. Raises JobError, a sentence with the line and the path of the key, where the text is no
    YAML, has over `most_values` keys and values, or holds what no job file needs: aliases, tags, deep nesting.
    """
    if len(text) > MOST_CHARACTERS:
        raise JobError(f"has {len(text)} characters, and may have {MOST_CHARACTERS}")
    try:
        _check_events(text, most_values)
        return yaml.load(text, Loader=_StrictLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        problem = " ".join(part for part in (error.context, error.problem) if part)
        raise JobError(f"not YAML: {where}{plain_line(problem, 200)}") from error
    except (yaml.YAMLError, UnicodeEncodeError) as error:
        raise JobError(f"not YAML: {plain_line(str(error), 200)}") from error


def _check_events(text: str, most_values: int) -> None:
    """Raises JobError at the first event that goes over a bound; nothing is built, and no stack grows."""
    frames: list[_Frame] = []
    values = 0
    for event in yaml.parse(text, Loader=_StrictLoader):
        if isinstance(event, yaml.CollectionEndEvent):
            frames.pop()
        if not isinstance(event, yaml.NodeEvent):
            continue
        values += 1
        if frames:
            frames[-1].pass_on(event)
        if isinstance(event, yaml.CollectionStartEvent):
            frames.append(_Frame(isinstance(event, yaml.MappingStartEvent)))
        fault = _fault(event)
        if values > most_values:
            fault = f"the text has over {most_values} keys and values"
        elif len(frames) > MOST_LEVELS:
            fault = f"is nested over {MOST_LEVELS} levels deep"
        if fault:
            words = [plain_line(str(frame.key), 40) for frame in frames[:8] if frame.key is not None]
            place = f"{'.'.join(words)}{'...' * (len(frames) > 8)}: " if words else ""
            raise JobError(f"line {_line_of(event)}: {place}{fault}")


def _line_of(event_or_node: Any) -> int:
    return int(event_or_node.start_mark.line) + 1


def _fault(event: Any) -> str:
    """Why a node is refused by itself; empty where it is not."""
    if isinstance(event, yaml.AliasEvent):
        return f"'*{plain_line(str(event.anchor), 40)}' repeats another part of the text: write it out"
    if event.tag is not None:
        return f"the tag '{plain_line(event.tag, 60)}' is not read: leave it out"
    if isinstance(event, yaml.ScalarEvent) and event.implicit[0] and len(event.value) > MOST_NUMBER_CHARACTERS:
        kind = _RESOLVER.resolve(yaml.ScalarNode, event.value, (True, False))
        if kind in _NUMBERS:
            shown = plain_line(event.value, 20)
            return f"{shown}: a number of {len(event.value)} characters; at most {MOST_NUMBER_CHARACTERS} are read"
    return ""


@dataclass
class _Frame:
    """A list or map that is being read: its key or position at this moment."""

    is_map: bool
    key: str | int | None = None
    value_next: bool = False

    def pass_on(self, event: yaml.NodeEvent) -> None:
        """Goes on to the next key, value or item."""
        if not self.is_map:
            self.key = 0 if self.key is None else int(self.key) + 1
        elif self.value_next:
            self.value_next = False
        else:
            self.key, self.value_next = getattr(event, "value", None), True
