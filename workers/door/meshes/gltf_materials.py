"""Edge: the materials of glTF files from outside: which of their pictures are read, and what a surface looks like.

A material is what `schemas.scene.shape.Material` holds: a colour with its picture, and one metalness and roughness. The table in
docs/own_meshes.md lists what glTF 2.0 and its extensions say of a surface, and what is done with each; what is not drawn leaves
a note.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Material
from workers.door.meshes.caps import FolderResolver
from workers.door.meshes.mesh import MIN_TINT, MeshVisual, make_material
from workers.geometry.colour import encode_srgb

Tree = dict[str, Any]

GLOSS = "KHR_materials_pbrSpecularGlossiness"
STRENGTH = "KHR_materials_emissive_strength"
TRANSFORM = "KHR_texture_transform"
_CLAMP, _MIRROR, _REPEAT = 33071, 33648, 10497
_PADS = {_CLAMP: "edge", _MIRROR: "symmetric"}
_MOST_TILED_PX = 8192
"""Longest side of a picture that is written out because it does not repeat; beyond, it repeats all the same."""
_SOURCES = ("EXT_texture_webp",)
"""Extensions of a texture that name a picture which can be read."""


@dataclass(frozen=True, eq=False)
class Look:
    """A material, and how a mesh finds its picture.

    coordinates: the attribute that holds texture coordinates; transform [3, 3] of them (v down); wrap: what is beyond the
    picture across and down, as in a glTF sampler; opaque: alpha means nothing.
    """

    material: Material
    coordinates: str
    transform: Array
    wrap: tuple[int, int]
    opaque: bool


class Materials:
    """The materials of a file, each made once."""

    def __init__(self, tree: Tree, resolver: FolderResolver, read_image: Callable[[Tree], bytes]) -> None:
        self._tree, self._resolver, self._read_image = tree, resolver, read_image
        self._pictures: dict[int, NDArray[np.uint8] | None] = {}
        self._looks: dict[int, Look] = {}
        self._tiled: dict[tuple[Any, ...], NDArray[np.uint8]] = {}

    def look(self, number: int) -> Look:
        """The material of a number. Pictures of colour are read before any other, so that a budget goes to them."""
        if not self._looks:
            for mesh in self._tree.get("meshes", []):
                for material in (p["material"] for p in mesh["primitives"] if "material" in p):
                    self._picture(color_of(self._tree["materials"][material]))
        if number not in self._looks:
            self._looks[number] = self._make(self._tree["materials"][number])
        return self._looks[number]

    def visual(self, look: Look, uv: Array, colors: NDArray[np.uint8] | None) -> MeshVisual:
        """The look of a mesh with texture coordinates [V, 2] as stored, v down; a picture that does not repeat is written out."""
        uv = (np.column_stack([uv, np.ones(len(uv))]) @ look.transform.T)[:, :2]
        picture = look.material.texture
        if picture is not None:
            picture, uv = self._tile(picture, uv, look.wrap)
        material = look.material if picture is look.material.texture else replace(look.material, texture=picture)
        return MeshVisual(material, np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]), colors)

    def _make(self, source: Tree) -> Look:
        rough, gloss = source.get("pbrMetallicRoughness", {}), source.get("extensions", {}).get(GLOSS)
        reference = color_of(source)
        picture = self._picture(reference)
        if gloss is None:
            linear = _factor(rough.get("baseColorFactor"), 4)
            metallic, roughness = self._metal(rough)
        else:
            linear, metallic, roughness = self._from_gloss(gloss, picture)
        linear, picture, emits = self._emission(source, linear, picture)
        color = np.append(encode_srgb(np.clip(linear[:3], 0.0, 1.0)), linear[3])
        color[3], picture = self._alpha(source, float(color[3]), picture)
        notes = self._resolver.notes
        material = make_material(color, metallic, roughness, picture, notes, _left_out(source, emits))
        notes += ["emission is drawn as a plain colour"] * emits
        reference = (source.get("emissiveTexture") if emits else reference) or {}
        more = reference.get("extensions", {}).get(TRANSFORM, {})
        sampler = self._sampler(reference)
        return Look(
            material,
            f"TEXCOORD_{int(more.get('texCoord', reference.get('texCoord', 0)))}",
            _transform(more),
            (sampler.get("wrapS", _REPEAT), sampler.get("wrapT", _REPEAT)),
            source.get("alphaMode", "OPAQUE") == "OPAQUE",
        )

    def _metal(self, rough: Tree) -> tuple[float, float]:
        """Metalness and roughness: factors times the mean of their picture; no metal where the picture cannot be read."""
        metallic, roughness = float(rough.get("metallicFactor", 1.0)), float(rough.get("roughnessFactor", 1.0))
        reference = rough.get("metallicRoughnessTexture")
        if reference is None:
            return metallic, roughness
        picture = self._picture(reference)
        if picture is None:
            return 0.0, roughness
        _, green, blue = picture[..., :3].reshape(-1, 3).mean(axis=0) / 255.0
        return metallic * float(blue), roughness * float(green)

    def _from_gloss(self, gloss: Tree, picture: NDArray | None) -> tuple[Array, float, float]:
        """Linear colour [4], metalness and roughness; a metal where nothing is diffuse and much is specular."""
        diffuse, specular = _factor(gloss.get("diffuseFactor"), 4), _factor(gloss.get("specularFactor"), 3)
        shine, reference = float(gloss.get("glossinessFactor", 1.0)), gloss.get("specularGlossinessTexture")
        found = None if reference is None else self._picture(reference)
        if found is not None:
            mean = found.reshape(-1, found.shape[2]).mean(axis=0) / 255.0
            specular = specular * mean[:3] ** 2.2
            shine *= float(mean[3]) if len(mean) == 4 else 1.0
        if picture is None and diffuse[:3].max() < MIN_TINT and specular.max() > 0.3:
            return np.append(specular, diffuse[3]), 1.0, 1.0 - shine
        return diffuse, 0.0, 1.0 - shine

    def _emission(
        self, source: Tree, linear: Array, picture: NDArray[np.uint8] | None
    ) -> tuple[Array, NDArray[np.uint8] | None, bool]:
        """Colour and picture; those of the light that a surface gives off where it has no other colour, and whether it is so."""
        emitted = _factor(source.get("emissiveFactor", (0.0, 0.0, 0.0)), 3)
        if emitted.max() <= 0.0 or linear[:3].max() >= MIN_TINT:
            return linear, picture, False
        reference = source.get("emissiveTexture")
        strength = float(source.get("extensions", {}).get(STRENGTH, {}).get("emissiveStrength", 1.0))
        color = np.append(np.clip(strength * emitted, 0.0, 1.0), linear[3])
        return color, None if reference is None else self._picture(reference), True

    def _alpha(
        self, source: Tree, alpha: float, picture: NDArray[np.uint8] | None
    ) -> tuple[float, NDArray[np.uint8] | None]:
        """Alpha and picture as `alphaMode` says: of OPAQUE none, of MASK holes with hard edges, of BLEND as they are."""
        mode = source.get("alphaMode", "OPAQUE")
        if mode == "BLEND":
            return alpha, picture
        if picture is None or picture.shape[2] == 3:
            return 1.0, picture
        solid = picture[..., 3] * (alpha / 255.0) >= float(source.get("alphaCutoff", 0.5))
        if mode != "MASK" or solid.all():
            picture = np.ascontiguousarray(picture[..., :3])
        else:
            picture = np.dstack([picture[..., :3], np.where(solid, 255, 0).astype(np.uint8)])
        picture.setflags(write=False)
        return 1.0, picture

    def _picture(self, reference: Tree | None) -> NDArray[np.uint8] | None:
        """The picture that a reference to a texture means, [h, w, 3 or 4] uint8; None with a note where it cannot be had."""
        if reference is None:
            return None
        number, why = image_of(self._tree, reference)
        if number is None:
            self._resolver.note("a texture", why)
            return None
        if number not in self._pictures:
            self._pictures[number] = self._decode(number)
        return self._pictures[number]

    def _decode(self, number: int) -> NDArray[np.uint8] | None:
        image = self._tree["images"][number]
        uri = image.get("uri")
        name = uri if isinstance(uri, str) and not uri.startswith("data:") else f"image {number}"
        with suppress(FileNotFoundError):  # the resolver has noted it
            return self._resolver.decode(name, self._read_image(image))
        return None

    def _sampler(self, reference: Tree) -> Tree:
        number = self._tree["textures"][reference["index"]].get("sampler") if reference else None
        return {} if number is None else dict(self._tree["samplers"][number])

    def _tile(self, picture: NDArray[np.uint8], uv: Array, wrap: tuple[int, int]) -> tuple[NDArray[np.uint8], Array]:
        """The picture and coordinates [V, 2]; one that does not repeat is written out as far as they reach beyond its edge."""
        pads = [(0, 0), (0, 0), (0, 0)]
        uv, modes = uv.copy(), [_PADS.get(mode) for mode in wrap]
        for k, mode in enumerate(modes):
            low, high = int(np.floor(uv[:, k].min() + 1e-3)), int(np.ceil(uv[:, k].max() - 1e-3))
            low, high, side = min(low, 0), max(high, 1), picture.shape[1 - k]
            if mode is None or (low, high) == (0, 1):
                continue
            if side * (high - low) > _MOST_TILED_PX:
                self._resolver.notes.append("a picture that does not repeat was repeated: it reaches too far")
                continue
            pads[1 - k] = (-low * side, (high - 1) * side)
            uv[:, k] = (uv[:, k] - low) / (high - low)
        if not any(map(any, pads)):
            return picture, uv
        key = (id(picture), tuple(pads), wrap)
        if key not in self._tiled:
            tiled = picture
            for k, mode in enumerate(modes):
                if mode is not None:
                    only = [pad if axis == 1 - k else (0, 0) for axis, pad in enumerate(pads)]
                    tiled = np.pad(tiled, only, mode=mode)  # type: ignore[call-overload]
            tiled.setflags(write=False)
            self._tiled[key] = tiled
        return self._tiled[key], uv


def color_of(material: Tree) -> Tree | None:
    """A material's reference to the picture of its colour."""
    gloss = material.get("extensions", {}).get(GLOSS)
    rough = material.get("pbrMetallicRoughness", {})
    found = rough.get("baseColorTexture") if gloss is None else gloss.get("diffuseTexture")
    return found if isinstance(found, dict) else None


def read_references(material: Tree) -> Iterator[Tree]:
    """References to the pictures of a material that may be read: colour, metal and roughness, gloss, emission."""
    gloss = material.get("extensions", {}).get(GLOSS, {})
    rough = material.get("pbrMetallicRoughness", {})
    found = (rough.get("metallicRoughnessTexture"), gloss.get("specularGlossinessTexture"))
    yield from (
        item for item in (color_of(material), *found, material.get("emissiveTexture")) if isinstance(item, dict)
    )


def image_of(tree: Tree, reference: Tree) -> tuple[int | None, str]:
    """The number of the picture that a reference to a texture means; None, and why, where it is in a format that is not read."""
    texture = tree["textures"][reference["index"]]
    extensions = texture.get("extensions", {})
    sources = [texture.get("source"), *(extensions[name].get("source") for name in _SOURCES if name in extensions)]
    number = next((number for number in sources if number is not None), None)
    if number is not None:
        return int(number), ""
    return None, f"is in a format that is not read ({', '.join(extensions) or 'none is named'}): convert it to PNG"


def _factor(value: Any, size: int) -> Array:
    return np.ones(size) if value is None else np.asarray(value, dtype=np.float64).reshape(size)


def _transform(stated: Tree) -> Array:
    """[3, 3] of KHR_texture_transform: offset times rotation times scale, on coordinates whose v runs down."""
    (x, y), (across, down) = stated.get("offset", (0.0, 0.0)), stated.get("scale", (1.0, 1.0))
    c, s = np.cos(float(stated.get("rotation", 0.0))), np.sin(float(stated.get("rotation", 0.0)))
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]]) @ turned @ np.diag([across, down, 1.0])


_PLAIN_MAPS = ("normalTexture", "occlusionTexture")


def _left_out(source: Tree, emits: bool) -> list[str]:
    """What of a material is not drawn."""
    found = [name for name in _PLAIN_MAPS if name in source]
    lit = max(_factor(source.get("emissiveFactor", (0.0, 0.0, 0.0)), 3)) > 0.0
    found += ["emission"] if lit and not emits else []
    return found + sorted(name for name in source.get("extensions", {}) if name not in (GLOSS, STRENGTH))
