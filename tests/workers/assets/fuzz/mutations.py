"""Hostile versions of whole assets, the same for the same seed: what a broken exporter or an attacker would write."""

import json
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from tests.workers.assets.fuzz.seeds import SEEDS, Files

Change = Callable[[bytes, np.random.Generator], bytes]

MOST_BYTES = 8_000_000
"""A mutant is cut at this size: what is larger is refused by its size alone."""

NUMBERS = [
    b"1e300", b"-1e300", b"1e400", b"1e200", b"1e-300", b"nan", b"inf", b"-inf", b"-1", b"0", b"-0.0", b"1e9", b"1e-9",
    b"2147483648", b"4294967295", b"-2147483649", b"9223372036854775808", b"1" * 5000, b"0x10", b"1_0", b"", b"\xc2\xb2",
]  # fmt: skip
NAMES = [
    b"../../../etc/passwd", b"/etc/passwd", b"a\0b", b"a" * 100_000, b"a/" * 50_000, b"/dev/zero", b"/proc/self/mem", b".",
    b"..", b"", b"a.obj", b"\xff\xfe.png", b"~root/x.png", b"http://127.0.0.1/x.png", b"file:///etc/passwd", b"con\n.png",
    b"C:\\x\\skin.png", b"a.urdf", b"%s%n",
]  # fmt: skip
WORDS = [0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFFE, 1 << 20, 0x7FC00000, 0x7F800000, 0xFF7FFFFF]
VALUES: list[Any] = [
    1e400, -1, 0, 2**31, 2**63, 10**30, 1e300, -1e300, float("nan"), "", "x" * 100_000, "\ud800", None, True, [], {}, [[]],
    [1e308] * 16, {"a": {}}, [0] * 100_000, 5120, 5126, "MAT4", "SCALAR", [10**6], "data:;base64,AAAA", "../skin.png",
]  # fmt: skip

_NUMBER = re.compile(rb"(?<![\w.])-?\d+(\.\d+)?([eE][-+]?\d+)?")
_NAME = re.compile(rb"[\w./-]+\.(?:png|jpg|mtl|obj|bin)")


def _pick(rng: np.random.Generator, values: list[Any]) -> Any:
    return values[int(rng.integers(len(values)))]


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes changed."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 20))):
        changed[int(rng.integers(len(data)))] = int(rng.integers(256))
    return bytes(changed)


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """The end, or something in the middle, lost."""
    start, stop = sorted(int(k) for k in rng.integers(0, len(data) + 1, 2))
    return data[:start] if rng.random() < 0.5 else data[:start] + data[stop:]


def double(data: bytes, rng: np.random.Generator) -> bytes:
    """A block of bytes repeated."""
    start, stop = sorted(int(k) for k in rng.integers(0, len(data) + 1, 2))
    return data[:stop] + data[start:stop] * int(rng.integers(1, 4)) + data[stop:]


def word(data: bytes, rng: np.random.Generator) -> bytes:
    """Four bytes that are a count, an index, an offset or a float, replaced by an extreme."""
    at = int(rng.integers(max(1, len(data) - 4)))
    return data[:at] + struct.pack("<I", _pick(rng, WORDS)) + data[at + 4 :]


def number(data: bytes, rng: np.random.Generator) -> bytes:
    """Numbers of a text replaced by extremes."""
    found = list(_NUMBER.finditer(data))
    for match in sorted(rng.permutation(len(found))[: int(rng.integers(1, 4))], reverse=True):
        one = found[match]
        data = data[: one.start()] + _pick(rng, NUMBERS) + data[one.end() :]
    return data


def name(data: bytes, rng: np.random.Generator) -> bytes:
    """File names replaced by those of files elsewhere, and by names that are none."""
    new = _pick(rng, NAMES)
    return _NAME.sub(lambda _: new, data)


def repeat(data: bytes, rng: np.random.Generator) -> bytes:
    """A line, or some of them, many times."""
    lines = data.split(b"\n")
    at = int(rng.integers(len(lines)))
    some = lines[at : at + int(rng.integers(1, 5))]
    return b"\n".join([*lines[:at], *(some * int(10 ** rng.integers(2, 6))), *lines[at:]])


def nest(data: bytes, rng: np.random.Generator) -> bytes:
    """An opening bracket or element many times."""
    deep = int(10 ** rng.integers(2, 6))
    opening, closing = _pick(
        rng, [(b"[", b"]"), (b'{"a":', b"}"), (b"<link>", b"</link>"), (b"<visual>", b"</visual>")]
    )
    at = int(rng.integers(len(data) + 1))
    return data[:at] + opening * deep + data[at:] + closing * deep


def bomb(data: bytes, rng: np.random.Generator) -> bytes:
    """A picture of very many pixels, that is or only says that it is one."""
    side = int(_pick(rng, [1, 4096, 8192, 16384, 65535, 2**31 - 1]))
    rows = min(side, 8192)
    pixels = (
        zlib.compress(bytes(min(side, 8192) * 3 + 1) * rows, 9) if rng.random() < 0.3 else zlib.compress(b"\0" * 100)
    )
    head = struct.pack(">IIBBBBB", side, side, int(_pick(rng, [1, 8, 16])), int(_pick(rng, [0, 2, 3, 6])), 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", pixels), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )


def tree(data: bytes, rng: np.random.Generator) -> bytes:
    """Values of a GLB's JSON replaced by others, copied, or lost."""
    try:
        (length,) = struct.unpack_from("<I", data, 12)
        root = json.loads(data[20 : 20 + length])
    except (struct.error, ValueError):
        return flip(data, rng)
    text = json.dumps(_replaced(root, rng)).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def text_tree(data: bytes, rng: np.random.Generator) -> bytes:
    """The same for a JSON file."""
    try:
        return json.dumps(_replaced(json.loads(data), rng)).encode()
    except (ValueError, IndexError, RecursionError):
        return flip(data, rng)


def _replaced(root: Any, rng: np.random.Generator) -> Any:
    for _ in range(int(rng.integers(1, 4))):
        places = list(_places(root))
        holder, key = places[int(rng.integers(len(places)))]
        if isinstance(holder, list) and rng.random() < 0.2:
            holder.extend([holder[key]] * int(10 ** rng.integers(0, 5)))
        elif rng.random() < 0.1:
            del holder[key]
        else:
            holder[key] = _pick(rng, VALUES)
    return root


def _places(value: Any) -> Any:
    keys = list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
    for key in keys[:2000]:
        yield value, key
        yield from _places(value[key])


ANY: tuple[Change, ...] = (flip, cut, double, word, repeat, nest)
CHANGES: Mapping[str, tuple[Change, ...]] = {
    "obj": (*ANY, number, number, number, name),
    "mtl": (*ANY, number, name, name),
    "urdf": (*ANY, number, number, number, name, nest),
    "ply": (*ANY, word, number, number, name),
    "stl": (*ANY, word, word, number),
    "glb": (flip, cut, word, tree, tree, tree, tree, nest),
    "gltf": (flip, cut, text_tree, text_tree, text_tree, text_tree, nest, number, name),
    "bin": (flip, cut, word, double),
    "png": (flip, cut, word, bomb, bomb),
    "jpg": (flip, cut, word, bomb),
}


def mutant(seed: int, index: int) -> tuple[str, Files]:
    """A description and the files of one hostile asset; the first file is what a source's map finds."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    kinds = sorted(SEEDS)
    kind = kinds[index % len(kinds)]
    files = dict(SEEDS[kind])
    first, how = next(iter(files)), []
    for _ in range(int(rng.integers(1, 3))):
        target = _pick(rng, [first, *files])
        change = _pick(rng, list(CHANGES[target.rpartition(".")[2]]))
        files[target] = change(files[target] or b"\0", rng)[:MOST_BYTES]
        how.append(f"{change.__name__} {target}")
    if rng.random() < 0.05:  # one format under another's name
        other = str(_pick(rng, ["a.obj", "a.stl", "a.ply", "a.glb", "a.gltf", "a.urdf"]))
        files = {other: files.pop(first), **files}
        how.append(f"as {other}")
    return f"{kind}: {', '.join(how)}", files
