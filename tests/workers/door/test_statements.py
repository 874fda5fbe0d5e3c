"""What files say of shape and look, one row a statement: it is obeyed, or named.

Every row is a cube of 0.2 m with a picture on each side, and differs in one statement. The right answers are those of the
specifications, written by hand: glTF 2.0 and its extensions, MTL, and what programs write into OBJ, PLY and STL.
"""

import base64
import io
import re
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from tests.workers.door.oracles import CUBE, glb, urdf, visual, welded, write_all
from workers.assets.library.reading import list_files, load_file
from workers.door.meshes.formats import load_shape

CORNERS = np.array([[x, y, z] for z in (0, 0.2) for x, y in ((-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1))])
SIDES = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
UV = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
SKIN, RED, GREEN, GREY, WHITE = (200, 150, 100), (220, 30, 30), (30, 220, 30), (178, 178, 178), (255, 255, 255)


def image(*colours, mode="RGB", kind="PNG", size=16):
    """A picture in as many upright bands as there are colours."""
    made = Image.new(mode, (size * len(colours), size))
    for k, colour in enumerate(colours):
        made.paste(colour, (k * size, 0, (k + 1) * size, size))
    stream = io.BytesIO()
    made.save(stream, kind)
    return stream.getvalue()


@dataclass
class Gltf:
    """A cube as binary glTF, to which a row adds its statement."""

    tree: dict[str, Any] = field(default_factory=dict)
    data: bytes = b""
    files: dict[str, bytes] = field(default_factory=dict)

    def __post_init__(self):
        positions = CORNERS[np.ravel(SIDES)].astype("<f4")
        self.tree = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
        self.tree |= {"bufferViews": [], "accessors": [], "images": [], "textures": [], "samplers": []}
        self.rough: dict[str, Any] = {"metallicFactor": 0.0}
        self.material: dict[str, Any] = {"pbrMetallicRoughness": self.rough}
        faces = np.ravel([[4 * k + i for i in (0, 1, 2, 0, 2, 3)] for k in range(6)]).astype("<u2")
        attributes = {"POSITION": self.add(positions, "VEC3"), "TEXCOORD_0": self.add(np.tile(UV, (6, 1)), "VEC2")}
        self.part = {"attributes": attributes, "indices": self.add(faces, "SCALAR", 5123), "material": 0}
        self.tree |= {"meshes": [{"primitives": [self.part]}], "materials": [self.material]}

    def view(self, data, **more):
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)} | more)
        self.data += data
        return len(self.tree["bufferViews"]) - 1

    def add(self, array, kind, component=5126, **more):
        array = np.asarray(array, "<f4" if component == 5126 else None)
        more |= {"bufferView": self.view(array.tobytes()), "componentType": component}
        self.tree["accessors"].append(more | {"count": len(array), "type": kind})
        return len(self.tree["accessors"]) - 1

    def picture(self, data=None, **stated):
        """A reference to a new texture of a PNG."""
        item = {"bufferView": self.view(data), "mimeType": "image/png"} if data is not None else stated
        self.tree["images"].append(item)
        self.tree["textures"].append({"source": len(self.tree["images"]) - 1})
        return {"index": len(self.tree["textures"]) - 1}

    def paint(self, data=None, **more):
        self.rough["baseColorTexture"] = self.picture(image(SKIN) if data is None else data) | more
        return self

    def sample(self, **sampler):
        self.tree["samplers"], self.tree["textures"][0]["sampler"] = [sampler], 0

    def need(self, *names):
        self.tree["extensionsUsed"] = self.tree["extensionsRequired"] = list(names)

    def written(self):
        tree = {key: value for key, value in self.tree.items() if value != []}
        data = self.data + b"\0" * (-len(self.data) % 4)
        return {"a.glb": glb(tree | {"buffers": [{"byteLength": len(data)}]}, data), **self.files}


def made(change, data=None):
    """The files of a painted cube after a change."""
    cube = Gltf()
    cube.paint(data)
    change(cube)
    return cube.written()


def gloss(**stated):
    def change(cube):
        cube.tree["extensionsUsed"] = ["KHR_materials_pbrSpecularGlossiness"]
        stated.setdefault("diffuseTexture", cube.rough.pop("baseColorTexture"))
        cube.material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": stated}
        cube.material.pop("pbrMetallicRoughness")

    return change


def transformed(cube):
    cube.rough["baseColorTexture"]["extensions"] = {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [0.5, 1]}}


def turned(cube):
    """A quarter turn: u' = v and v' = -u, so that both bands stay, and of a cube's corner (0.9, 0.1) the first is seen."""
    cube.rough["baseColorTexture"]["extensions"] = {"KHR_texture_transform": {"rotation": np.pi / 2, "scale": [1, 0.4]}}


def second_coordinates(cube):
    cube.part["attributes"]["TEXCOORD_1"] = cube.add(np.tile(0.505 + 0.49 * UV, (6, 1)), "VEC2")
    cube.rough["baseColorTexture"]["texCoord"] = 1


def beyond(**sampler):
    def change(cube):
        cube.part["attributes"]["TEXCOORD_0"] = cube.add(np.tile(UV * [0.5, 1] + [1, 0], (6, 1)), "VEC2")
        cube.sample(**sampler)

    return change


def metal_map(cube):
    cube.rough.pop("metallicFactor")
    cube.rough["metallicRoughnessTexture"] = cube.picture(image((255, 204, 0)))


def many_maps(cube):
    for name in ("normalTexture", "occlusionTexture"):
        cube.material[name] = cube.picture(b"RIFF1234WEBPVP8 no picture")


def in_extension(cube, data, name):
    cube.tree["textures"] = [{"extensions": {name: {"source": 0}}}]
    cube.tree["images"] = [{"bufferView": cube.view(data)}]
    cube.tree["extensionsUsed"] = [name]


def beside(**stated):
    def change(cube):
        cube.tree["images"][0] = stated
        cube.files["Textures/t.png"] = image(SKIN)

    return change


def emissive(cube):
    cube.rough["baseColorFactor"] = [0, 0, 0, 1]
    cube.rough.pop("baseColorTexture")
    cube.material |= {"emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 0}}


def morphed(cube):
    target = np.repeat([[0.0, 0.0, 0.3]], 24, axis=0) * (CORNERS[np.ravel(SIDES)][:, 2:] > 0)
    cube.part["targets"] = [{"POSITION": cube.add(target, "VEC3")}]
    cube.tree["meshes"][0]["weights"] = [0.5]


def skinned(cube):
    """Two joints: the lower one doubles what it holds, the upper one moves it up by 0.1. The node's own scale means nothing."""
    cube.tree["nodes"] = [
        {"mesh": 0, "skin": 0, "scale": [9, 9, 9]},
        {"scale": [2, 2, 2]},
        {"translation": [0, 0, 0.1]},
    ]
    cube.tree["scenes"] = [{"nodes": [0, 1, 2]}]
    top = CORNERS[np.ravel(SIDES)][:, 2] > 0
    joints = np.zeros((24, 4), "<u2")
    joints[top, 0] = 1
    shares = np.tile([1.0, 0, 0, 0], (24, 1))
    cube.part["attributes"] |= {"JOINTS_0": cube.add(joints, "VEC4", 5123), "WEIGHTS_0": cube.add(shares, "VEC4")}
    back = np.tile(np.eye(4), (2, 1, 1))
    back[1, 2, 3] = 0.05
    matrices = cube.add(back.transpose(0, 2, 1).reshape(2, 16), "MAT4")
    cube.tree["skins"] = [{"joints": [1, 2], "inverseBindMatrices": matrices}]


def instanced(cube):
    shifts = cube.add([[0, 0, 0], [0.5, 0, 0], [1, 0, 0]], "VEC3")
    cube.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": shifts}}}
    cube.need("EXT_mesh_gpu_instancing")


def sparse(cube):
    at, to = cube.view(np.array([0], "<u2").tobytes()), cube.view(np.array([[-0.1, -0.1, -0.4]], "<f4").tobytes())
    cube.tree["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": at, "componentType": 5123},
        "values": {"bufferView": to},
    }


def quantised(cube):
    small = np.zeros((24, 4), "<i2")
    small[:, :3] = np.round(CORNERS[np.ravel(SIDES)] / 0.2 * 32767)
    cube.tree["accessors"][0] = {"bufferView": cube.view(small.tobytes(), byteStride=8), "componentType": 5122}
    cube.tree["accessors"][0] |= {"normalized": True, "count": 24, "type": "VEC3"}
    cube.tree["nodes"][0]["scale"] = [0.2, 0.2, 0.2]
    cube.need("KHR_mesh_quantization")


def obj(
    material="Kd 1 1 1\nmap_Kd t.png\n", first="mtllib m.mtl", use="usemtl a", more="", files=None, end="\n", **lines
):
    """The cube as OBJ with a material; `points`, `faces`: lines in place of the usual ones."""
    points = [f"v {x:g} {y:g} {z:g}{more}" for x, y, z in CORNERS]
    faces = [f"f {' '.join(f'{c + 1}/{k + 1}' for k, c in enumerate(side))}" for side in SIDES]
    corners = ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    text = [first, *lines.get("points", points), *corners, use, *lines.get("faces", faces)]
    named = {"t.png": image(SKIN), "m.mtl": f"newmtl a\n{material}".encode()}
    return {"a.obj": end.join(text).encode() + end.encode(), **named, **(files or {})}


def ply(vertex="", face="", head="", shared=True, row=lambda k, c: "", tail=lambda k: "", **elements):
    """The cube as PLY in text, with more properties of vertices and faces."""
    axes = "property float x\nproperty float y\nproperty float z\n"
    places = [(0, c) for c in range(8)] if shared else [(k, c) for side in SIDES for k, c in enumerate(side)]
    points = "".join("{:g} {:g} {:g} {}\n".format(*CORNERS[c], row(k, c)) for k, c in places)
    index = [side if shared else range(4 * k, 4 * k + 4) for k, side in enumerate(SIDES)]
    corners = "".join(f"4 {' '.join(map(str, side))} {tail(k)}\n" for k, side in enumerate(index))
    faces = f"element face 6\nproperty list uchar int vertex_indices\n{face}"
    text = f"ply\nformat ascii 1.0\n{head}element vertex {len(places)}\n{axes}{vertex}"
    return {
        "a.ply": (
            text + elements.get("faces", faces) + "end_header\n" + points + elements.get("rows", corners)
        ).encode()
    }


RGB = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
STRIPS = "element tristrips 1\nproperty list int int vertex_indices\n"
STRIP = "20 0 1 3 2 7 6 4 5 0 1 -1 1 5 2 6 -1 0 3 4 7\n"
POINTER = b"version https://git-lfs.github.com/spec/v1\n"
MIXED = ["f 1 4 3 2", "f 5/1 6/1 7/1 8/1", "f 1// 2// 6// 5//", "f 2 3 7 6 #", "f 3/1/ 4/2/ 8/3/ 7/4/", "f 4 1 5 8"]
APART = [f"v {x:g} {y:g} {z:g}" for side in SIDES for x, y, z in CORNERS[list(side)]]
BACK = [f"f {' '.join(str(4 * k + i - 24) for i in range(4))}" for k in range(6)]


def ply_by_vertex(u, v, more=""):
    names = f"property float {u}\nproperty float {v}\n"
    files = ply(names, "", "comment TextureFile t.png\n", False, lambda k, c: f"{k % 2} 0{more}")
    return files | {"t.png": image(SKIN)}


def filled_up(data):
    """The file with NUL behind its tree in place of spaces."""
    (length,) = struct.unpack_from("<I", data, 12)
    text, rest = data[20 : 20 + length].rstrip() + b"\0" * 8, data[20 + length :]
    text += b"\0" * (-len(text) % 4)
    return data[:8] + struct.pack("<II", 20 + len(text) + len(rest), len(text)) + data[16:20] + text + rest


def off(head="OFF", more="", behind=""):
    """The cube as OFF, with more behind its vertices and faces."""
    points = [f"{x:g} {y:g} {z:g}{more}" for x, y, z in CORNERS]
    faces = [f"4 {' '.join(map(str, side))}{behind}" for side in SIDES]
    return {"a.off": "\n".join([head, "# a remark", "8 6 12", "", *points, *faces]).encode()}


def stl(behind=b"", colour=b""):
    cube = trimesh.creation.box((0.2, 0.2, 0.2))
    data = trimesh.exchange.stl.export_stl(cube)
    return {"a.stl": colour.ljust(80, b" ") + data[80:] + behind}


ARRAY = (
    '<source id="{0}"><float_array id="{0}-a" count="{2}">{1}</float_array><technique_common>'
    '<accessor source="#{0}-a" count="{3}" stride="{4}"/></technique_common></source>'
)
INPUTS = '<input semantic="VERTEX" source="#v" offset="0"/><input semantic="TEXCOORD" source="#uv" offset="1"/>'
RING = [f"{c} {k}" for side in SIDES for k, c in enumerate(side)]


def wrong_count(count, cut=0):
    """The cube as a binary STL whose head tells another count, and that misses its last bytes."""
    (data,) = stl().values()
    data = data[:80] + struct.pack("<I", count) + data[84:]
    return {"a.stl": data[: len(data) - cut]}


def part(kind, *orders, more=""):
    """A primitive of the six sides, each once for every order of its corners."""
    runs = [" ".join(RING[4 * k + i] for i in order) for k in range(6) for order in orders]
    runs = [" ".join(runs)] if kind in ("polylist", "triangles") else runs
    rings = "".join(f"<p>{run}</p>" for run in runs)
    return f"<{kind} count='6' material='m'>{INPUTS}{more}{rings}</{kind}>"


SIDE = (0, 1, 2, 3)
FOURS = f"<vcount>{'4 ' * 6}</vcount>"
PARTS = {
    "polylist": part("polylist", SIDE, more=FOURS),
    "polygons": part("polygons", SIDE),
    "trifans": part("trifans", SIDE),
    "tristrips": part("tristrips", (0, 1, 3, 2)),
    "triangles": part("triangles", (0, 1, 2), (0, 2, 3)),
}
SKIN_PNG = image(SKIN)
PICTURE = '<texture texture="sampler" texcoord="UVSET0"/>'
SAMPLER = (
    '<newparam sid="surface"><surface type="2D"><init_from>image</init_from></surface></newparam>'
    '<newparam sid="sampler"><sampler2D><source>surface</source></sampler2D></newparam>'
)
SHOWN = (
    '<instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="m" target="#skin">{}'
    "</instance_material></technique_common></bind_material></instance_geometry>"
)


def array(name, values):
    values = np.asarray(values)
    return ARRAY.format(name, " ".join(f"{x:g}" for x in values.ravel()), values.size, len(values), values.shape[1])


def geometry(part=PARTS["polylist"], more="", size=1.0, name="g", vertex="", stretch=(1, 1, 1)):
    points = '<vertices id="v"><input semantic="POSITION" source="#p"/>' + vertex + "</vertices>"
    arrays = array("p", size * CORNERS * stretch) + array("uv", UV * [1, -1] + [0, 1]) + more
    return f'<geometry id="{name}"><mesh>{arrays}{points}{part}</mesh></geometry>'


def dae(
    diffuse=PICTURE,
    surface="",
    node=None,
    shapes="",
    params=SAMPLER,
    image="t.png",
    asset="",
    data=None,
    binding="",
    more="",
):
    """The cube as COLLADA, which a row changes in one statement."""
    effect = f"<technique><phong><diffuse>{diffuse}</diffuse>{surface}</phong>{more}</technique>"
    text = (
        '<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
        f"<asset>{asset}</asset><library_images><image id='image'><init_from>{image}</init_from></image></library_images>"
        f"<library_effects><effect id='e'><profile_COMMON>{params}{effect}</profile_COMMON></effect></library_effects>"
        "<library_materials><material id='skin'><instance_effect url='#e'/></material></library_materials>"
        f"<library_geometries>{shapes or geometry()}</library_geometries><library_nodes><node id='n'>{SHOWN}</node>"
        "</library_nodes><library_visual_scenes><visual_scene id='s'><node>"
        f"{SHOWN.format(binding) if node is None else node}</node></visual_scene></library_visual_scenes>"
        "<scene><instance_visual_scene url='#s'/></scene></COLLADA>"
    )
    return {"a.dae": text.encode(), "t.png": data or SKIN_PNG}


def with_commas(files):
    """The numbers of a COLLADA file as programs write them in a country of commas."""
    text = files["a.dae"].replace(b'meter="1.0"', b'meter="1,0"')
    return {**files, "a.dae": re.sub(rb">[^<]*</float_array>", lambda array: array[0].replace(b".", b","), text)}


@dataclass(frozen=True)
class Right:
    """What is right of a row: colours that are seen, in 8 bits of sRGB; None: a hole."""

    colours: tuple[Any, ...] = (SKIN,)
    metallic: float = 0.0
    roughness: float | None = None
    note: str = ""
    extents: tuple[float, ...] = (0.2, 0.2, 0.2)
    volume: float | None = 0.008


BANDS = image(RED, GREEN)
CLEAR = image((*RED, 255), (*GREEN, 0), mode="RGBA")

ROWS: dict[str, tuple[dict[str, bytes], Right | str]] = {
    # glTF: pictures and how they lie
    "glb": (Gltf().paint().written(), Right(roughness=1.0)),
    "texture transform": (made(transformed, BANDS), Right((GREEN,))),
    "texture transform that turns": (made(turned, BANDS), Right((RED,))),
    "second texture coordinates": (made(second_coordinates, BANDS), Right((GREEN,))),
    "repeat": (made(beyond(), BANDS), Right((RED,))),
    "clamp to edge": (made(beyond(wrapS=33071), BANDS), Right((GREEN,))),
    "mirrored repeat": (made(beyond(wrapS=33648), BANDS), Right((GREEN,))),
    "picture beside": (made(beside(uri="Textures/t.png")), Right()),
    "picture of another folder": (made(beside(uri="../t.png")), Right((WHITE,), note="../t.png is missing")),
    "picture as data": (
        made(beside(uri="data:image/png;base64," + base64.b64encode(image(SKIN)).decode())),
        Right(),
    ),
    "webp": (made(lambda c: in_extension(c, image(SKIN, kind="WEBP"), "EXT_texture_webp")), Right()),
    "ktx2": (
        made(lambda c: in_extension(c, b"\xabKTX 20", "KHR_texture_basisu")),
        Right((WHITE,), note="KHR_texture_basisu"),
    ),
    "16-bit grey": (made(lambda c: None, image(150 * 257, mode="I;16")), Right(((150, 150, 150),))),
    "other maps that cannot be read": (made(many_maps), Right(note="not drawn: normalTexture, occlusionTexture")),
    # glTF: materials
    "opaque": (made(lambda c: None, CLEAR), Right((RED, GREEN))),
    "mask": (made(lambda c: c.material.update(alphaMode="MASK"), CLEAR), Right((RED, None))),
    "mask of a low cutoff": (
        made(lambda c: c.material.update(alphaMode="MASK", alphaCutoff=0.0), CLEAR),
        Right((RED, GREEN)),
    ),
    "blend": (made(lambda c: c.material.update(alphaMode="BLEND"), CLEAR), Right((RED, None))),
    "metal in a picture": (made(metal_map), Right(roughness=0.8)),
    "metal": (made(lambda c: c.rough.pop("metallicFactor")), Right(metallic=1.0, roughness=1.0)),
    "no material": (made(lambda c: c.part.pop("material")), Right((WHITE,))),
    "specular and gloss": (made(gloss(specularFactor=[0.2, 0.2, 0.2], glossinessFactor=0.75)), Right(roughness=0.25)),
    "specular of a metal": (
        made(gloss(diffuseFactor=[0, 0, 0, 1], diffuseTexture=None, specularFactor=[1, 0, 0])),
        Right(((255, 0, 0),), metallic=1.0, roughness=0.0),
    ),
    "emission alone": (made(emissive), Right(note="emission is drawn")),
    "emission beside a colour": (
        made(lambda c: c.material.update(emissiveFactor=[1, 1, 1])),
        Right(note="not drawn: emission"),
    ),
    "an extension of materials": (
        made(lambda c: c.material.update(extensions={"KHR_materials_transmission": {"transmissionFactor": 1}})),
        Right(note="KHR_materials_transmission"),
    ),
    # glTF: shape
    "morph": (made(morphed), Right(extents=(0.2, 0.2, 0.35), volume=0.014)),
    "skin": (made(skinned), Right(extents=(0.4, 0.4, 0.35), volume=None)),
    "instances": (made(instanced), Right(extents=(1.2, 0.2, 0.2), volume=0.024)),
    "sparse": (made(sparse), Right(extents=(0.2, 0.2, 0.6), volume=None)),
    "quantised": (made(quantised), Right()),
    "an unknown extension that is required": (made(lambda c: c.need("EXT_some_day")), "EXT_some_day"),
    "compressed": (made(lambda c: c.need("KHR_draco_mesh_compression")), "KHR_draco_mesh_compression"),
    "filled up with NUL": ({"a.glb": filled_up(Gltf().paint().written()["a.glb"])}, Right()),
    "version 1": ({"a.glb": struct.pack("<4sIIII", b"glTF", 1, 20, 0, 0)}, "version 1"),
    # OBJ and MTL
    "obj": (obj(), Right(roughness=(2 / 3) ** 0.25)),
    "no Kd": (obj("map_Kd t.png\n"), Right()),
    "black Kd": (obj("Kd 0 0 0\nmap_Kd t.png\n"), Right(note="grey Kd")),
    "grey Kd": (obj("Kd 0.588 0.588 0.588\nmap_Kd t.png\n"), Right(note="a grey Kd of 0.588")),
    "shininess of an MTL": (obj("Kd 1 1 1\nNs 30\nmap_Kd t.png\n"), Right(roughness=0.5)),
    "red Kd": (obj("Kd 1 0 0\nmap_Kd t.png\n"), Right(((200, 0, 0),))),
    "no material file": (obj(first="", use=""), Right((GREY,), note="t.png beside it was not used")),
    "a material file that is missing": (
        obj(first="mtllib n.mtl", files={"a.mtl": b""}),
        Right((GREY,), note="a.mtl was read"),
    ),
    "a material that is not defined": (obj(use="usemtl b"), Right((GREY,))),
    "a material that is not used": (obj(use=""), Right()),
    "two material files in a line": (obj(first="mtllib n.mtl m.mtl", files={"n.mtl": b"newmtl n\n"}), Right()),
    "a material file with spaces": (
        obj(first="mtllib my m.mtl", files={"my m.mtl": b"newmtl a\nmap_Kd t.png\n"}),
        Right(),
    ),
    "the material file of the same name": (
        obj(first="mtllib x.mtl", files={"a.mtl": b"newmtl a\nmap_Kd t.png"}),
        Right(note="x.mtl is missing: a.mtl was read"),
    ),
    "options that change nothing": (obj("map_Kd -s 1 1 1 -o 0 0 0 -clamp on t.png\n"), Right()),
    "options that do": (obj("map_Kd -s 2 2 t.png\n"), Right(note="ignored -s 2 2")),
    "a name in other case": (obj("map_Kd T.PNG\n"), Right(note="T.PNG is missing: t.png was read")),
    "a picture in the folder of pictures": (
        obj("map_Kd u.png\n", files={"textures/u.png": image(GREEN)}),
        Right((GREEN,)),
    ),
    "UDIM": (obj("map_Kd t.<UDIM>.png\n"), Right((WHITE,), note="UDIM")),
    "opacity": (obj("map_Kd t.png\nmap_d o.png\n", files={"o.png": image(0, mode="L")}), Right((None,))),
    "emission of an MTL": (obj("Kd 0 0 0\nKe 1 0 0\n"), Right(((255, 0, 0),), note="Ke")),
    "physically based": (obj("Kd 1 0 0\nPm 1\nPr 0.3\n"), Right(((255, 0, 0),), metallic=1.0, roughness=0.3)),
    "a bump map": (obj("map_Kd t.png\nmap_Bump b.png\n"), Right(note="not drawn: map_bump")),
    "colours of vertices": (obj("Kd 0.5 0.5 0.5\n", more=" 1 0 0"), Right(((255, 0, 0),))),
    "colours of vertices up to 255": (obj("Kd 0.5 0.5 0.5\n", more=" 200 150 100"), Right()),
    "w": (obj(more=" 1.0"), Right()),
    "line ends of old": (obj(end="\r"), Right()),
    "decimal commas": (
        obj(points=[f"v {x:g} {y:g} {z:g}".replace(".", ",") for x, y, z in CORNERS]),
        Right(note="decimal commas"),
    ),
    "decimal commas in a dae": (with_commas(dae(asset='<unit meter="1.0"/>')), Right(note="decimal commas")),
    "coordinates that are not there": (
        {**(plain := obj("Kd 1 0 0\n")), "a.obj": re.sub(rb"vt .*\n", b"", plain["a.obj"])},
        Right(((255, 0, 0),)),
    ),
    "faces of mixed forms": (obj("Kd 1 0 0\n", faces=MIXED), Right(((255, 0, 0),))),
    "counted back": (obj("Kd 1 0 0\n", points=APART, faces=BACK), Right(((255, 0, 0),))),
    **{
        f"a picture as {kind}": (obj(f"map_Kd u.{kind}\n", files={f"u.{kind}": image(SKIN, kind=kind)}), Right())
        for kind in ("BMP", "TGA", "TIFF", "WEBP")
    },
    "a pointer of Git LFS": (obj(files={"t.png": POINTER}), Right((WHITE,), note="git lfs pull")),
    # PLY
    "ply": (ply(), Right((GREY,))),
    "ply colours": (ply(RGB, row=lambda k, c: "200 150 100"), Right()),
    "ply diffuse colours": (ply(RGB.replace("uchar ", "uchar diffuse_"), row=lambda k, c: "200 150 100"), Right()),
    "ply colours as floats": (ply(RGB.replace("uchar", "float"), row=lambda k, c: "1 0 0"), Right(((255, 0, 0),))),
    "ply colours of faces": (ply(face=RGB, tail=lambda k: "200 150 100"), Right()),
    "ply picture by vertex": (ply_by_vertex("s", "t"), Right()),
    "ply picture as BOP has it": (ply_by_vertex("texture_u", "texture_v"), Right()),
    "ply picture by corner": (
        ply(
            "",
            "property list uchar float texcoord\n",
            "comment TextureFile t.png\n",
            tail=lambda k: "8 0 0 0.4 0 0.4 1 0 1",
        )
        | {"t.png": BANDS},
        Right((RED,)),
    ),
    "ply pictures by number": (
        ply(
            "",
            "property list uchar float texcoord\nproperty int texnumber\n",
            "comment TextureFile t.png\ncomment TextureFile u.png\n",
            tail=lambda k: f"8 0 0 1 0 1 1 0 1 {k % 2}",
        )
        | {"t.png": image(RED), "u.png": image(GREEN)},
        Right((RED, GREEN)),
    ),
    "ply with more in a line than its head says": (ply_by_vertex("s", "t", " 7"), Right()),
    "ply strips": (ply(faces=STRIPS, rows=STRIP), Right((GREY,))),
    "ply points": (ply(faces="", rows=""), "cloud of points"),
    # COLLADA
    "dae": (dae(), Right(roughness=(2 / 3) ** 0.25)),
    **{f"dae of {name}": (dae(shapes=geometry(part)), Right()) for name, part in PARTS.items()},
    "dae in inches": (dae(asset='<unit meter="0.0254"/>'), Right(extents=(0.00508,) * 3, volume=0.00508**3)),
    "dae transforms": (
        dae(
            node="<matrix>2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix><node><rotate>0 0 1 90</rotate><scale>1 3 1</scale>"
            f"{SHOWN}</node>"
        ),
        Right(extents=(1.2, 0.2, 0.2), volume=0.048),
    ),
    "dae of Assimp": (dae(node=f'<node id="<STL_BINARY>" name="<STL_BINARY>">{SHOWN}</node>'), Right()),
    "dae instances of a node": (
        dae(node="<instance_node url='#n'/><node><translate>0.5 0 0</translate><instance_node url='#n'/></node>"),
        Right(extents=(0.7, 0.2, 0.2), volume=0.016),
    ),
    "dae ids that two shapes have": (
        dae(shapes=geometry(size=2.0) + geometry(name="h"), node=SHOWN + SHOWN.replace("#g", "#h")),
        Right(extents=(0.4, 0.4, 0.4), volume=0.064 + 0.008),
    ),
    "dae second coordinates": (
        dae(
            data=BANDS,
            binding='<bind_vertex_input semantic="UVSET0" input_semantic="TEXCOORD" input_set="1"/>',
            shapes=geometry(
                part("polylist", SIDE, more=f'<input semantic="TEXCOORD" source="#uv2" offset="1" set="1"/>{FOURS}'),
                array("uv2", 0.505 + 0.49 * UV),
            ),
        ),
        Right((GREEN,)),
    ),
    "dae picture that is named at once": (dae(diffuse='<texture texture="image" texcoord="x"/>', params=""), Right()),
    "dae of version 1.5": (
        dae(
            params="<newparam sid='sampler'><sampler2D><instance_image url='#image'/></sampler2D></newparam>",
            image="<ref>t.png</ref>",
        ),
        Right(),
    ),
    "dae picture as an address": (dae(image="file:///C:/of%20me/t%2Epng"), Right()),
    "dae picture that is missing": (dae(image="u.png"), Right((WHITE,), note="u.png is missing")),
    "dae picture that is not defined": (dae(diffuse='<texture texture="q"/>'), Right((WHITE,), note="is not defined")),
    "dae wrap": (
        dae(params=SAMPLER.replace("</source>", "</source><wrap_s>CLAMP</wrap_s>")),
        Right(note="does not repeat (CLAMP)"),
    ),
    "dae colour": (dae("<color>1 0 0 1</color>"), Right(((255, 0, 0),))),
    "dae no material": (dae(node='<instance_geometry url="#g"/>'), Right((GREY,), note="#m is missing")),
    "dae shininess": (dae(surface="<shininess><float>30</float></shininess>"), Right(roughness=0.5)),
    "dae colours of vertices": (
        dae(
            "<color>0.5 0.5 0.5 1</color>",
            shapes=geometry(
                more=array("c", np.tile([1, 0, 0], (8, 1))), vertex='<input semantic="COLOR" source="#c"/>'
            ),
        ),
        Right(((255, 0, 0),)),
    ),
    "dae emission alone": (
        dae("<color>0 0 0 1</color>", "<emission><color>1 0 0 1</color></emission>"),
        Right(((255, 0, 0),), note="emission is drawn"),
    ),
    "dae emission beside a colour": (
        dae(surface="<emission><color>1 0 0 1</color></emission>"),
        Right(note="not drawn: emission"),
    ),
    "dae bump": (dae(more="<extra><technique><bump/></technique></extra>"), Right(note="not drawn: bump")),
    **{
        f"dae transparent, {mode} of {color} times {share}": (
            dae(
                surface=f'<transparent opaque="{mode}"><color>{color}</color></transparent>'
                f"<transparency><float>{share}</float></transparency>"
            ),
            Right((SKIN,) if seen else (None,)),
        )
        for mode, color, share, seen in (
            ("A_ONE", "1 1 1 1", 1, True),
            ("A_ONE", "1 1 1 0.25", 1, False),
            ("A_ONE", "0 0 0 1", 0.25, False),
            ("RGB_ZERO", "0 0 0 1", 1, True),
            ("RGB_ZERO", "1 1 1 1", 0.75, False),
            ("RGB_ONE", "0.2 0.2 0.2 1", 1, False),
            ("A_ZERO", "0 0 0 0.75", 1, False),
            ("A_ZERO", "1 1 1 0", 1, True),
        )
    },
    "dae transparent as Autodesk has it": (
        dae(surface="<transparent><color>1 1 1 1</color></transparent><transparency><float>0</float></transparency>"),
        Right(note="an alpha of 0"),
    ),
    "dae alpha of a picture of colour": (dae(data=CLEAR), Right((RED, GREEN))),
    "dae alpha of a picture that is transparent": (
        dae(data=CLEAR, surface=f"<transparent>{PICTURE}</transparent>"),
        Right((RED, None)),
    ),
    "dae skin": (dae(node='<instance_controller url="#g"/>'), "is a skin or morphs"),
    "dae holes": (
        dae(shapes=geometry(f"<polygons>{INPUTS}<ph><p>{' '.join(RING[:4])}</p><h>0 0</h></ph></polygons>")),
        "polygons with holes",
    ),
    "dae skewed": (dae(node=f"<skew>45 0 1 0 1 0 0</skew>{SHOWN}"), "<skew>"),
    "dae spline": (dae(shapes='<geometry id="g"><spline/></geometry>'), "no mesh"),
    "dae in another file": (dae(node='<instance_geometry url="b.dae#g"/>'), "b.dae#g"),
    # STL and OFF
    "off": (off(), Right((GREY,))),
    "off with faces over lines": (
        {"a.off": re.sub(rb"(?m)^4 (\d+) (\d+) ", rb"4 \1 \n\2\n", off()["a.off"])},
        Right((GREY,)),
    ),
    "off of trimesh": (
        {"a.off": trimesh.creation.box((0.2, 0.2, 0.2)).export(file_type="off").encode()},
        Right((GREY,)),
    ),
    "off without its word": (off(head=""), Right((GREY,))),
    "off colours of vertices": (off("COFF", " 200 150 100 255"), Right()),
    "off colours as shares behind normals": (off("CNOFF", " 0 0 1 1.0 0 0 1"), Right(((255, 0, 0),))),
    "off colours of faces": (off(behind=" 200 150 100"), Right()),
    "off colours of a map": (off(behind=" 3"), Right((GREY,), note="colours of a map")),
    "off in four dimensions": (off("4OFF", " 1"), "three dimensions"),
    "off in binary": (off("OFF BINARY"), "three dimensions"),
    "stl": (stl(), Right((GREY,))),
    "stl with bytes behind": (stl(b"\0\0"), Right((GREY,))),
    "stl with a count too small": (wrong_count(7), Right((GREY,), note="its head tells 7 faces, and 12 are there")),
    "stl with a count too large": (
        wrong_count(4711),
        Right((GREY,), note="its head tells 4711 faces, and 12 are there"),
    ),
    "stl without a count": (wrong_count(0), Right((GREY,), note="its head tells 0 faces, and 12 are there")),
    "stl that ends early": (wrong_count(12, cut=20), "ends early: 11 of 12 faces are there"),
    "clear vertices": (
        ply(f"{RGB}property uchar alpha\n", row=lambda k, c: "220 30 30 0"),
        Right((RED,), note="an alpha of 0 of vertices"),
    ),
    "stl with a colour in its head": (stl(colour=b"COLOR=\xff\0\0\xff"), Right((GREY,))),
}


def seen(shape):
    """The colours at a third of the way from each triangle's corners to its middle, in 8 bits of sRGB; None for a hole."""
    found = set()
    for part in shape.parts:
        base = np.round(255 * np.array(part.material.base_color))
        for corner in range(3):
            weights = np.full(3, 0.2)
            weights[corner] = 0.6
            colour = np.tile(base, (len(part.faces), 1))
            if part.colors is not None:
                colour = colour * part.colors[part.faces[:, 0]] / 255
            if part.material.texture is not None and part.uv is not None:
                u, v = (np.einsum("fki,k->fi", part.uv[part.faces], weights) % 1.0).T
                height, width, channels = part.material.texture.shape
                texel = part.material.texture[((1 - v) * height).astype(int) % height, (u * width).astype(int) % width]
                colour[:, :channels] = colour[:, :channels] * texel / 255
            found |= {None if alpha < 128 else tuple(rgb) for *rgb, alpha in colour.tolist()}
    return found


def faults(path, right):
    """What is wrong of a file that is read."""
    loaded = load_shape(path, MeshLimits())
    shape, material = loaded.shape, loaded.shape.parts[0].material
    colours, notes = seen(shape), "; ".join(loaded.notes)

    def match(one, other):
        return one is other if one is None or other is None else np.allclose(one, other, atol=4.0)

    if not np.allclose(shape.bounds[1] - shape.bounds[0], right.extents, atol=1e-5):
        yield f"extents {shape.bounds[1] - shape.bounds[0]}"
    if not all(any(match(c, wanted) for c in colours) for wanted in right.colours):
        yield f"colours {colours} for {right.colours}"
    if not all(any(match(c, wanted) for wanted in right.colours) for c in colours):
        yield f"colours {colours} beside {right.colours}"
    if abs(material.metallic - right.metallic) > 0.01:
        yield f"metallic {material.metallic}"
    if right.roughness is not None and abs(material.roughness - right.roughness) > 0.01:
        yield f"roughness {material.roughness}"
    if (right.note not in notes) if right.note else notes:
        yield f"notes {notes!r}"
    if right.volume is not None:
        mesh = welded(shape)
        if not (shape.closed and mesh.is_watertight and abs(mesh.volume / right.volume - 1) < 1e-4):
            yield f"volume {mesh.volume} closed {shape.closed}"


def test_what_a_file_states_is_obeyed_or_named(tmp_path):
    found = {}
    for k, (name, (files, right)) in enumerate(ROWS.items()):
        path = write_all(tmp_path / str(k), files)
        if isinstance(right, str):
            with pytest.raises(MeshError, match=right):
                load_shape(path, MeshLimits())
        elif told := list(faults(path, right)):
            found[name] = told
    assert not found, "\n".join(f"{name}: {told}" for name, told in found.items())


DECLARED = '<?xml version="1.0" encoding="{}"?>'
SPHERE = "<sphere><radius>0.1</radius></sphere>"
TEXTS = {
    "a.obj": obj("map_Kd ü.png\n", "mtllib ü.mtl"),
    "a.dae": dae(image="ü.png"),
    "a.ply": ply_by_vertex("s", "t"),
    "a.urdf": {"a.urdf": urdf(visual('<mesh filename="ü.obj"/>')).encode()},
    "a.sdf": {"a.sdf": f"<sdf><model><link>{visual(SPHERE)}</link></model><!-- ü --></sdf>".encode()},
    "a.xml": {"a.xml": "<mujoco model='ü'><worldbody><geom type='mesh' mesh='ü'/></worldbody>"
              "<asset><mesh file='ü.obj'/></asset></mujoco>".encode()},
    "a.off": {"a.off": b"OFF # \xc3\xbc\n" + off()["a.off"].removeprefix(b"OFF")},
}  # fmt: skip


@pytest.mark.parametrize("name", TEXTS)
def test_a_text_is_read_by_its_mark_its_declaration_or_as_latin_1_with_a_note(tmp_path, name):
    kind = name[2:]
    for k, (encoding, declares) in enumerate(
        (("utf-8", ""), ("utf-8-sig", ""), ("utf-16", ""), ("iso-8859-1", ""), ("iso-8859-1", "iso-8859-1"),
         ("windows-1250", "windows-1250"), ("utf-8", "utf-16"), ("iso-8859-1", "utf-8"), ("utf-8", "no-such"))
    ):  # fmt: skip
        if (kind in ("obj", "ply", "off") and declares) or (kind == "ply" and encoding == "utf-16"):
            continue
        files = {
            "ü.obj": CUBE.encode(),
            "ü.mtl": b"newmtl a\nmap_Kd \xc3\xbc.png\n",
            "ü.png": image(SKIN),
            **TEXTS[name],
        }
        for text in (name, "ü.mtl"):
            whole = (
                files[text]
                .decode()
                .replace("TextureFile t.png", "TextureFile ü.png")
                .replace('<?xml version="1.0"?>', "")
            )
            files[text] = (DECLARED.format(declares) * bool(declares) * (text == name) + whole).encode(encoding)
        path = write_all(tmp_path / str(k), files).with_name(name)
        list_files(path.parent, path, MeshLimits())
        loaded = load_file(path.parent, path, MeshLimits())
        if kind in ("obj", "dae", "ply"):
            assert {tuple(colour) for colour in seen(loaded.shape)} == {SKIN}, (encoding, declares)
        told = f"{name} is not in UTF-8: read as Latin-1" in loaded.notes
        assert told == (encoding == "iso-8859-1" and declares != "iso-8859-1"), (encoding, declares, loaded.notes)


def polygon(corners):
    """A shape of COLLADA with one face."""
    points = (
        array("p", [(x, 0.5, y) for x, y in corners])
        + '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
    )
    face = '<polygons><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2 3 4 5</p></polygons>'
    return f'<geometry id="g"><mesh>{points}{face}</mesh></geometry>'


PLY_OF_SIX = (
    "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
)


def test_concave_polygons_are_cut_along_their_inside(tmp_path):
    """An L of three squares, from each of its corners, in both windings: three squares of area, and no part outside."""
    ring = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
    for turn in range(6):
        for way in (1, -1):
            corners = (ring[turn:] + ring[:turn])[::way]
            text = "".join(f"v {x} 0.5 {y}\n" for x, y in corners) + "f 1 2 3 4 5 6\n"
            points = "".join(f"{x} 0.5 {y}\n" for x, y in corners)
            drawn = "6 0 1 2 3 4 5\n"
            for name, data in (
                ("a.obj", text),
                ("a.ply", PLY_OF_SIX + points + drawn),
                ("a.off", "OFF\n6 1 6\n" + points + drawn),
                ("a.dae", dae(shapes=polygon(corners))["a.dae"].decode()),
            ):
                shape = load_shape(write_all(tmp_path, {name: data.encode()}), MeshLimits()).shape
                mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
                assert mesh.area == pytest.approx(3.0) and len(shape.faces) == 4
                assert not ((mesh.triangles_center[:, 0] > 1) & (mesh.triangles_center[:, 2] > 1)).any()


def test_a_sliver_that_closes_a_body_stays_where_another_body_is_open(tmp_path):
    """A box whose upper side meets a wall at a point in the middle of an edge, closed by a triangle without area; and a sheet."""
    text = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in [*CORNERS, (0, -0.1, 0.2), (1, 0, 0), (2, 0, 0), (1, 1, 0)])
    text += "".join(f"f {' '.join(str(c + 1) for c in side)}\n" for side in SIDES if side != SIDES[1])
    text += "f 5 9 8\nf 9 6 7\nf 9 7 8\nf 5 6 9\nf 10 11 12\n"
    shape = load_shape(write_all(tmp_path, {"a.obj": text.encode()}), MeshLimits()).shape
    (box,) = shape.parts
    faces = box.faces[(box.vertices[box.faces][:, :, 0].max(axis=1) < 0.5)]
    points = np.unique(np.round(box.vertices, 9), axis=0, return_inverse=True)[1].reshape(-1)[faces]
    assert trimesh.Trimesh(np.zeros((points.max() + 1, 3)), points, process=False).is_watertight
