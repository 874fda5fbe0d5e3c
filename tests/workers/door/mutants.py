"""Hostile versions of whole assets, the same for the same number: what a broken exporter or an attacker would write."""

import io
import json
import random
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from tests.mutations import mutated_bytes, mutated_tree, places
from tests.workers.door.oracles import CUBE, Files, glb, gltf, picture, textured_obj
from tests.workers.door.test_statements import SHOWN, dae, off

Change = Callable[[random.Random, bytes], bytes]

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
    "x" * 100_000, "\ud800", None, [], {}, [[]], float("nan"), [1e308] * 16, [0] * 100_000, 5120, 5126, "MAT4", "SCALAR",
    [10**6], "data:;base64,AAAA", "../skin.png",
]  # fmt: skip

_NUMBER = re.compile(rb"(?<![\w.])-?\d+(\.\d+)?([eE][-+]?\d+)?")
_NAME = re.compile(rb"[\w./-]+\.(?:png|jpg|mtl|obj|bin)")


def word(dice: random.Random, data: bytes) -> bytes:
    """Four bytes that are a count, an index, an offset or a float, replaced by an extreme."""
    at = dice.randrange(max(1, len(data) - 4))
    return data[:at] + struct.pack("<I", dice.choice(WORDS)) + data[at + 4 :]


def number(dice: random.Random, data: bytes) -> bytes:
    """Numbers of a text replaced by extremes."""
    found = list(_NUMBER.finditer(data))
    chosen = dice.sample(found, min(len(found), dice.randint(1, 3)))
    for one in sorted(chosen, key=lambda match: -match.start()):
        data = data[: one.start()] + dice.choice(NUMBERS) + data[one.end() :]
    return data


def name(dice: random.Random, data: bytes) -> bytes:
    """File names replaced by those of files elsewhere, and by names that are none."""
    new = dice.choice(NAMES)
    return _NAME.sub(lambda _: new, data)


def repeat(dice: random.Random, data: bytes) -> bytes:
    """A line, or some of them, many times."""
    lines = data.split(b"\n")
    at = dice.randrange(len(lines))
    return b"\n".join([*lines[:at], *(lines[at : at + dice.randint(1, 4)] * 10 ** dice.randint(2, 5)), *lines[at:]])


def nest(dice: random.Random, data: bytes) -> bytes:
    """An opening bracket or element many times."""
    opening, closing = dice.choice(
        [(b"[", b"]"), (b'{"a":', b"}"), *((b"<%s>" % tag, b"</%s>" % tag) for tag in (b"link", b"visual", b"node"))]
    )
    deep, at = 10 ** dice.randint(2, 5), dice.randrange(len(data) + 1)
    return data[:at] + opening * deep + data[at:] + closing * deep


def bomb(dice: random.Random, data: bytes) -> bytes:
    """A picture of very many pixels, that is or only says that it is one."""
    side = dice.choice([1, 4096, 8192, 16384, 65535, 2**31 - 1])
    rows = min(side, 8192)
    pixels = zlib.compress(bytes(rows * 3 + 1) * rows if dice.random() < 0.3 else bytes(100), 9)
    head = struct.pack(">IIBBBBB", side, side, dice.choice([1, 8, 16]), dice.choice([0, 2, 3, 6]), 0, 0, 0)
    return png_of(head, pixels)


def png_of(head: bytes, pixels: bytes) -> bytes:
    """A PNG of a header and compressed pixels, whatever these are."""
    chunks = ((b"IHDR", head), (b"IDAT", pixels), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )


def tree(dice: random.Random, data: bytes) -> bytes:
    """Values of a glTF file's JSON replaced by others, copied, moved or lost."""
    binary = data.startswith(b"glTF")
    try:
        length = struct.unpack_from("<I", data, 12)[0] if binary else len(data)
        root = mutated_tree(dice, json.loads(data[20 : 20 + length] if binary else data))
        for _ in range(dice.randint(0, 2)):
            holder, key = dice.choice(list(places(root)))
            holder[key] = dice.choice(VALUES)
        return glb(root, data[28 + length :]) if binary else json.dumps(root).encode()
    except (struct.error, ValueError, IndexError, RecursionError):
        return mutated_bytes(dice, data)


CHANGES: Mapping[str, tuple[Change, ...]] = {
    "obj": (word, repeat, nest, number, number, number, name),
    "mtl": (word, repeat, nest, number, name, name),
    "urdf": (repeat, nest, nest, number, number, number, name),
    "ply": (word, word, repeat, number, number, name),
    "stl": (word, word, word, repeat, number),
    "off": (repeat, number, number),
    "dae": (repeat, nest, number, number, number, name),
    "glb": (word, tree, tree, tree, tree, nest),
    "gltf": (tree, tree, tree, tree, nest, number, name),
    "bin": (word, word),
    "png": (word, bomb, bomb),
    "jpg": (word, bomb),
}
"""What is done to the files of each kind, beside `mutated_bytes`."""


def mutant(index: int) -> tuple[str, Files]:
    """A description and the files of one hostile asset; the first file is what a source's map finds."""
    dice = random.Random(20260101 + index)
    kind = sorted(SEEDS)[index % len(SEEDS)]
    files = dict(SEEDS[kind])
    first, how = next(iter(files)), []
    for _ in range(dice.randint(1, 2)):
        target = dice.choice([first, *files])
        change = dice.choice([*CHANGES[target.rpartition(".")[2]], mutated_bytes, mutated_bytes])
        files[target] = change(dice, files[target] or b"\0")[:MOST_BYTES]
        how.append(f"{change.__name__} {target}")
    if dice.random() < 0.05:  # one format under another's name
        other = dice.choice(["a.obj", "a.stl", "a.ply", "a.dae", "a.glb", "a.gltf", "a.urdf"])
        files = {other: files.pop(first), **files}
        how.append(f"as {other}")
    return f"{index} {kind}: {', '.join(how)}", files


def exported(mesh: Any, kind: str, **more: str) -> bytes:
    """The mesh as trimesh writes it."""
    data = mesh.export(file_type=kind, **more)
    return data.encode() if isinstance(data, str) else data


def coloured_box() -> trimesh.Trimesh:
    """A box whose vertices have colours."""
    colors = np.random.default_rng(1).integers(0, 255, (8, 4), dtype=np.uint8)
    return trimesh.Trimesh(BOX.vertices, BOX.faces, vertex_colors=colors, process=False)


def textured_scene() -> trimesh.Scene:
    """Three balls, each in the frame of the one before, with pictures."""
    scene, image = trimesh.Scene(), Image.open(io.BytesIO(picture(colour=None)))
    for k in range(3):
        mesh = trimesh.creation.icosphere(1, 0.05)
        uv = np.random.default_rng(k).random((len(mesh.vertices), 2))
        skin = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
        mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=skin)
        T, parent = trimesh.transformations.translation_matrix((0.1, 0, 0)), f"n{k - 1}" if k else None
        scene.add_geometry(mesh, node_name=f"n{k}", parent_node_name=parent, transform=T)
    return scene


URDF = b"""<?xml version="1.0"?>
<robot name="thing">
  <material name="red"><color rgba="0.9 0.1 0.1 1"/></material>
  <link name="base"><visual><origin xyz="0 0 0.1" rpy="0 0.2 0"/><geometry><box size="0.2 0.1 0.1"/></geometry>
    <material name="red"/></visual></link>
  <joint name="a" type="fixed"><parent link="base"/><child link="arm"/><origin xyz="0 0.1 0" rpy="0.1 0 0"/></joint>
  <link name="arm"><visual><geometry><cylinder radius="0.05" length="0.2"/></geometry></visual>
    <visual><geometry><mesh filename="mesh/cube.obj" scale="0.1 0.1 0.1"/></geometry></visual></link>
  <joint name="b" type="fixed"><parent link="arm"/><child link="ball"/><origin xyz="0 0 0.1"/></joint>
  <link name="ball"><visual><geometry><sphere radius="0.04"/></geometry></visual></link>
</robot>
"""
BOX = trimesh.creation.box((0.1, 0.2, 0.3))
_SKIN = {"skin.png": picture(colour=None, size=(16, 12))}
_NAMED = b"comment TextureFile skin.png\nelement vertex"


def _named_a(files: Files) -> Files:
    """The files with the first named `a`."""
    first = next(iter(files))
    return {f"a.{first.rpartition('.')[2]}": files[first], **{name: files[name] for name in files if name != first}}


SEEDS: Mapping[str, Files] = {
    "obj": {"a.obj": CUBE.encode()},
    "obj_png": {**_named_a(textured_obj(more="d 1.0\nNs 10\n")), **_SKIN},
    "obj_jpg": {**_named_a(textured_obj("skin.jpg")), "skin.jpg": picture("JPEG", (16, 12), None)},
    "ply": {"a.ply": exported(BOX, "ply", encoding="ascii").replace(b"element vertex", _NAMED, 1), **_SKIN},
    "ply_binary": {"a.ply": exported(coloured_box(), "ply")},
    "stl": {"a.stl": exported(BOX, "stl")},
    "off": off("COFF", " 255 0 0 255"),
    "stl_ascii": {"a.stl": exported(BOX, "stl_ascii")},
    "glb": {"a.glb": exported(textured_scene(), "glb")},
    "gltf": {**_named_a(gltf()), **_SKIN},
    "dae": dae(node=f"<rotate>0 0 1 30</rotate><node><scale>1 2 1</scale>{SHOWN}</node>"),
    "urdf": {"a.urdf": URDF, **{f"mesh/{name}": data for name, data in {**textured_obj(), **_SKIN}.items()}},
}
"""Whole assets: one of every format, with what it refers to."""
