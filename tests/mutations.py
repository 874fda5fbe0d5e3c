"""Seeded mutations of bytes and of trees of values: what damage, ignorance and malice make of a file."""

import copy
import random
from typing import Any

WORDS: tuple[Any, ...] = (
    *(None, True, False, "", " ", "x", "\0", "\x1b[31m", "\u202e", "²", "a" * 3000, "9" * 5000),
    *("../../victim", "/etc/passwd", "~nobody7/x", "name", "mug", "procedural", "urdf"),
    *("2024-13-45", "=", "<<", "nan", "1e999", "0x10", "*a", "&a"),
)
NUMBERS: tuple[Any, ...] = (
    *(0, -1, 1, 2, 65_536, 2**31, 2**53 + 1, 2**63, -(2**63) - 1, 10**30, 10**60),
    *(0.0, -0.0, 0.5, 1e-320, 1e308, -1e308, 1.5e10),
)
PIECES: tuple[bytes, ...] = (
    *(b"\0", b"\x1b[31m", b"\xff\xfe", b"\xed\xa0\x80", b"\xef\xbb\xbf", b"\t", b"\n", b"\r", b"\\", b"\\u0000"),
    *(b": ", b"- ", b"? ", b"[", b"]", b"{", b"}", b'"', b"'", b"#", b"|\n", b">\n", b"~", b"../"),
    *(b"&a ", b"*a ", b"!!int ", b"!!python/object/apply:os.system [true]", b"<<: "),
    *(b"---\n", b"...\n", b"%YAML 9.9\n"),
    *(b"0x", b"1e999", b".nan", b".inf", b"9" * 400, b"1:2:3", b"2024-13-45", b"[" * 200, b"{a: " * 200),
)


def mutated_bytes(dice: random.Random, data: bytes) -> bytes:
    """The bytes with one to four places flipped, cut out, repeated, or filled with something that a parser may stumble over."""
    for _ in range(dice.randint(1, 4)):
        at = dice.randrange(len(data) + 1)
        end = min(len(data), at + dice.choice((1, 1, 2, 8, 64)))
        kind = dice.randrange(5)
        if kind == 0:
            data = data[:at] + bytes(byte ^ (1 << dice.randrange(8)) for byte in data[at:end]) + data[end:]
        elif kind == 1:
            data = data[:at] + data[end:]
        elif kind == 2:
            data = data[:end] + data[at:end] * dice.choice((1, 2, 50)) + data[end:]
        elif kind == 3:
            data = data[: dice.choice((at, end, len(data)))]
        else:
            data = data[:at] + dice.choice(PIECES) + data[at:]
    return data


def mutated_tree(dice: random.Random, tree: Any) -> Any:
    """A copy of a tree of values with one to four of them replaced, nested, renamed, repeated, moved or taken out."""
    tree = copy.deepcopy(tree)
    for _ in range(dice.randint(1, 4)):
        found = list(places(tree))
        if found:
            branch, key = dice.choice(found)
            _mutate(dice, branch, key, found)
    return tree


def places(tree: Any) -> Any:
    """(branch, key) of every value below the top."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in list(items):
        yield tree, key
        yield from places(value)


def _mutate(dice: random.Random, branch: Any, key: Any, places: Any) -> None:
    value = branch[key]
    kind = dice.randrange(7)
    if kind == 0:
        branch[key] = dice.choice(WORDS)
    elif kind == 1:
        branch[key] = dice.choice(NUMBERS)
    elif kind == 2:
        branch[key] = _nested(dice, value)
    elif kind == 3:
        del branch[key]
    elif kind == 4 and isinstance(branch, dict):
        branch[dice.choice((str(key)[:-1], str(key).upper(), f"{key}s", dice.choice(WORDS)))] = branch.pop(key)
    elif kind == 5 and isinstance(branch, list):
        branch[key:key] = [copy.deepcopy(value)] * dice.choice((1, 2, 200))
    else:
        other, name = dice.choice(places)
        branch[key] = (
            copy.deepcopy(other[name]) if name in other or (isinstance(other, list) and name < len(other)) else None
        )


def _nested(dice: random.Random, value: Any) -> Any:
    for _ in range(dice.choice((1, 2, 40))):
        value = dice.choice(([value], {"a": value}, [value, value] if not isinstance(value, list | dict) else [value]))
    return value
