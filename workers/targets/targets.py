"""Image targets of a drawn view: what networks are trained on, from the faces that the pixels' rays meet. Pure.

A target says of each pixel what is at its centre, of the same faces as the stored mask, without light, lens or noise. Whatever
there is not is 0. Coordinates and normals are 16-bit: `value / 65535` is the stored number, from 0 to 1.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.job.job import Job
from schemas.job.views import Images, Targets
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import REGION_FLOOR, Material, Mesh, Part, Shape, is_object
from schemas.scene.view import FULL, LAYERS, MODALITIES, Camera, PixelKind
from workers.geometry.camera import NEAR_M, project, unproject
from workers.geometry.colour import SRGB_STEPS, decode_srgb
from workers.geometry.frames import invert, transform
from workers.geometry.mesh import corner_weights, mix
from workers.geometry.pixels import quantise_depth
from workers.geometry.raycast import Caster
from workers.stopwatch import Stopwatch
from workers.targets.coverage import cover_pixels
from workers.targets.painting import (
    CODES,
    Skin,
    paint_albedo,
    paint_faces,
    paint_layers,
    paint_points,
    paint_silhouettes,
)
from workers.targets.surfaces import Surfaces, Triangles, all_surfaces, nearest_faces, triangles_of

WHITE = Material()
"""Has the texture of a part without one."""

LINEAR = np.rint(SRGB_STEPS * FULL).astype(np.uint16)
"""[256] linear light of sRGB codes, in steps of 1 / FULL, of which the darkest code has 20."""

MOST_KEPT = 1 << 22
"""Numbers of a texture that is kept for the next view: a larger one would outlive its asset by hundreds of megabytes."""

OF_NEAREST, OF_ALL = ("normals", "coordinates", "albedo", "covisible"), ("layers", "amodal")
"""Targets of what is seen, and of everything along a pixel's ray."""


def draw_targets(
    things: Sequence[Placed],
    camera: Camera,
    region: NDArray[np.uint8],
    job: Job,
    effects: EffectPlan,
    watch: Stopwatch,
    sight: "Sight | None" = None,
) -> dict[PixelKind, NDArray]:
    """The image targets that the plan has of a view with the mask `region` [H, W], by modality; with a clear background `alpha`.

    `sight`: what the pair's input camera sees; None for the input view itself.
    """
    drawn: dict[PixelKind, NDArray] = {}
    things = _with_one_floor(things)
    objects = [thing for thing in things if is_object(thing.region_id)]
    of_seen = [name for name in OF_NEAREST if effects.runs(name) and (sight or MODALITIES[name].of_input)]
    if of_seen:
        with watch.stage("targets"):
            shown = things if effects.runs("normals") or effects.runs("albedo") else objects
            seen = Seen(shown, camera, region, job.captures is None, sight)
        for name in of_seen:
            with watch.stage("targets", name):
                drawn[name] = _OF_SEEN[name](seen, job.targets)
    if effects.runs("alpha"):
        with watch.stage("targets", "alpha"):
            drawn["alpha"] = cover_pixels(seen.triangles if of_seen else triangles_of(objects, camera), region)
    if any(effects.runs(name) for name in OF_ALL):
        with watch.stage("targets"):
            triangles = triangles_of(objects, camera)
            surfaces = all_surfaces(triangles)
        if effects.runs("amodal"):
            with watch.stage("targets", "amodal"):
                drawn["amodal"] = whole_silhouettes(triangles, surfaces, [thing.region_id for thing in objects])
        if effects.runs("layers"):
            with watch.stage("targets", "layers"):
                drawn |= peel_layers(triangles, surfaces, job.targets.layers, job.images)
    return drawn


def _with_one_floor(things: Sequence[Placed]) -> Sequence[Placed]:
    """The things with the floor and the walls, which have one region, as one."""
    floors = [thing for thing in things if thing.region_id == REGION_FLOOR]
    if len(floors) < 2:
        return things
    whole = Shape(tuple(part for thing in floors for part in thing.shape.parts))
    return [replace(floors[0], shape=whole), *(thing for thing in things if thing.region_id != REGION_FLOOR)]


class Seen:
    """What is seen at each pixel of a mask [H, W]: face [H, W] int32 of `triangles`, -1 for none, and z [H, W], metres.

    `drawn`: whether the mask is of these things, and not of a photograph. `sight`: what the pair's input camera sees.
    """

    def __init__(
        self,
        things: Sequence[Placed],
        camera: Camera,
        region: NDArray[np.uint8],
        drawn: bool,
        sight: "Sight | None" = None,
    ) -> None:
        self.things, self.camera, self.sight = things, camera, sight
        self.triangles = triangles_of(things, camera)
        self.face, self.z = nearest_faces(self.triangles, region, drawn)

    def by_thing(self) -> Iterator[tuple[Placed, NDArray[np.int64]]]:
        """Each thing with the pixels (flat numbers) that show it."""
        regions = np.append(self.triangles.region, np.uint8(0))[self.face]
        for thing in self.things:
            yield thing, np.flatnonzero(regions == thing.region_id)


def draw_normals(seen: Seen, targets: Targets) -> NDArray[np.uint16]:
    """[H, W, 3]: unit normals n in the camera's frame, towards the camera, as (n + 1) / 2; of shading with `targets.smooth`."""
    normals, offsets = seen.triangles.planes
    towards = np.where(offsets[:, None] > 0.0, -normals, normals)
    image = np.zeros((*seen.face.shape, 3), np.uint16)
    paint_faces(seen.face, _sixteen_bits((towards + 1.0) / 2.0), image)
    if targets.smooth:
        flat = image.reshape(-1, 3)
        for thing, pixels in seen.by_thing():
            turn = invert(seen.camera.T_world_cam)[:3, :3] @ thing.T_world_shape[:3, :3]
            for part, some, corners, weights in _parts_of(seen, thing, pixels):
                if part.normals is not None:
                    smooth = mix(part.normals, corners, weights) @ turn.T
                    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
                    # To the side that the face shows: at an outline a shading normal may look away a little.
                    shown = towards[seen.face.reshape(-1)[some]]
                    smooth *= np.where((smooth * shown).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
                    flat[some] = _sixteen_bits((smooth + 1.0) / 2.0)
    return image


def draw_coordinates(seen: Seen, targets: Targets) -> NDArray[np.uint16]:
    """[H, W, 3]: where on its object each pixel is: the middle of the object's box at 0.5, the box's diagonal as 1 (NOCS)."""
    image = np.zeros((*seen.face.shape, 3), np.uint16)
    for thing in seen.things:
        if is_object(thing.region_id):
            T_obj_cam = invert(thing.T_world_shape) @ seen.camera.T_world_cam
            place = np.ascontiguousarray(T_obj_cam), seen.triangles.k, *coordinate_scale(thing.shape)
            paint_points((seen.face, seen.z), seen.triangles.region, np.uint8(thing.region_id), *place, image)
    return image


def coordinate_scale(shape: Shape) -> tuple[float, Array]:
    """(scale, offset [3]), metres: an object's point is scale * value / 65535 + offset, in its own frame."""
    lower, upper = shape.bounds
    scale = float(np.linalg.norm(upper - lower))
    return scale, (lower + upper) / 2.0 - scale / 2.0


def draw_albedo(seen: Seen, targets: Targets) -> NDArray[np.uint8]:
    """[H, W, 3] sRGB: base colours, of textures bilinear among four texels in linear light, without light and shadow."""
    image, triangles = np.zeros((*seen.face.shape, 3), np.uint8), seen.triangles
    part_of, corners = np.empty(len(triangles.face), np.int32), np.empty((len(triangles.face), 3), np.int32)
    points, parts, vertices = list[Array](), list[Part](), 0
    for thing in seen.things:
        faces, shape = triangles.region == thing.region_id, thing.shape
        ends = np.cumsum([len(part.faces) for part in shape.parts])
        part_of[faces] = len(parts) + np.searchsorted(ends, triangles.face[faces], side="right")
        corners[faces] = shape.faces[triangles.face[faces]] + vertices
        points.append(transform(invert(seen.camera.T_world_cam) @ thing.T_world_shape, shape.vertices))
        vertices += len(shape.vertices)
        parts += shape.parts
    base = decode_srgb(np.array([part.material.base_color[:3] for part in parts]))
    values = np.concatenate([_values_of(part) for part in parts])
    skin = Skin(np.concatenate(points), values, corners, part_of, base, *_textures_of(parts))
    paint_albedo((seen.face, seen.z), skin, triangles.k, CODES, image)
    return image


def _textures_of(parts: Sequence[Part]) -> tuple[NDArray[np.uint16], NDArray[np.int64]]:
    """(texels, places) of `painting.Skin`; a texture that several parts have is there once."""
    kept, places, total = dict[int, tuple[int, NDArray[np.uint16]]](), [], 0
    for part in parts:
        material = WHITE if part.uv is None else part.material
        key = id(material.texture)
        if key not in kept:
            small = material.texture is None or material.texture.size <= MOST_KEPT
            texels = (_kept_texels if small else _texels_of)(material)
            kept[key] = total, texels
            total += texels.shape[0] * texels.shape[1]
        start, texels = kept[key]
        places.append((start, texels.shape[0] - 1, texels.shape[1] - 1))
    return np.concatenate([texels.reshape(-1, 3) for _, texels in kept.values()]), np.array(places)


def _texels_of(material: Material) -> NDArray[np.uint16]:
    """[h + 1, w + 1, 3]: the linear light of a texture, or of a white texel, and its first row and column once more."""
    texture = np.full((1, 1, 3), 255, np.uint8) if material.texture is None else material.texture
    return np.pad(LINEAR[texture[..., :3]], ((0, 1), (0, 1), (0, 0)), mode="wrap")


_kept_texels = lru_cache(maxsize=16)(_texels_of)


def _values_of(part: Part) -> Array:
    """[V, 5]: uv, and linear colours, of a part's vertices; 1 for none."""
    values = np.ones((len(part.vertices), 5))
    if part.uv is not None:
        values[:, :2] = part.uv
    if part.colors is not None:
        values[:, 2:] = SRGB_STEPS[part.colors[:, :3]]
    return values


SAME_M = 1e-5
"""A face whose plane lies this near to a point does not hide it: it is the point's own, or one beside it that rounding shows.

Of 214,767 rays of 50 scenes none met a face from 5 to 20 micrometres before its point; 10 did from 0.3 to 5.
"""


class Sight:
    """What the input camera of a pair sees, for every other view of it: the trees of things are built once, when first needed."""

    def __init__(self, things: Sequence[Placed], camera: Camera) -> None:
        self.things, self.camera = things, camera
        self._casters: dict[int, Caster] = {}

    def is_hidden(self, points: Array) -> NDArray[np.bool_]:
        """[N]: whether anything is between the input camera and points [N, 3], in its frame, metres, beyond the near plane."""
        hidden = np.zeros(len(points), np.bool_)
        for number in reversed(range(len(self.things))):  # objects first: they hide most
            left = np.flatnonzero(~hidden)
            if not len(left):
                break
            rays = points[left] / points[left, 2:]
            distance, cosine = self._caster(number).cast(NEAR_M * rays, rays)
            behind_m = np.where(cosine > 0.0, points[left, 2] - NEAR_M - distance, 0.0)
            hidden[left] = behind_m * np.linalg.norm(rays, axis=1) * cosine > SAME_M
        return hidden

    def _caster(self, number: int) -> Caster:
        """Of a thing in the camera's frame."""
        if number not in self._casters:
            thing, T_cam_world = self.things[number], invert(self.camera.T_world_cam)
            vertices = transform(T_cam_world @ thing.T_world_shape, thing.shape.vertices)
            self._casters[number] = Caster(Mesh(vertices, thing.shape.faces))
        return self._casters[number]


def draw_covisible(seen: Seen, targets: Targets) -> NDArray[np.uint8]:
    """[H, W]: 255 where the input camera sees the point of an object that the pixel shows; from the same side of its face."""
    sight = seen.sight
    assert sight is not None
    image, k = np.zeros(seen.face.shape, np.uint8), sight.camera.intrinsics
    pixels = np.flatnonzero(is_object(np.append(seen.triangles.region, np.uint8(0))[seen.face]))
    T_here_there = invert(seen.camera.T_world_cam) @ sight.camera.T_world_cam
    normals, offsets = (plane[seen.face.reshape(-1)[pixels]] for plane in seen.triangles.planes)
    pixels = pixels[(normals @ T_here_there[:3, 3] - offsets) * -offsets > 0.0]
    rows_columns = np.divmod(pixels, seen.camera.intrinsics.width)
    points = unproject(*rows_columns, seen.z.reshape(-1)[pixels], seen.camera.intrinsics)
    points = transform(invert(T_here_there), points)
    ahead = points[:, 2] > NEAR_M
    pixels, points = pixels[ahead], points[ahead]
    u, v = project(points, k)
    inside = (u >= 0.0) & (u < k.width) & (v >= 0.0) & (v < k.height)
    image.reshape(-1)[pixels[inside]] = np.where(sight.is_hidden(points[inside]), 0, 255)
    return image


def whole_silhouettes(triangles: Triangles, surfaces: Surfaces, regions: Sequence[int]) -> NDArray[np.uint8]:
    """[objects, H, W]: 255 where an object would be seen if nothing stood in front of it."""
    width, height = triangles.size
    place = np.full(256, -1, np.int64)
    place[list(regions)] = np.arange(len(regions))
    masks = np.zeros((len(regions), height, width), np.uint8)
    paint_silhouettes(surfaces.start, triangles.region[surfaces.face], place, masks.reshape(len(regions), -1))
    return masks


def peel_layers(
    triangles: Triangles, surfaces: Surfaces, count: int, images: Images
) -> dict[PixelKind, NDArray[np.uint16] | NDArray[np.uint8]]:
    """Depth and region [H, W] of the first `count` surfaces of objects along each pixel's ray, and of the last one."""
    width, height = triangles.size
    depth, region = np.zeros((count + 1, height, width), np.uint16), np.zeros((count + 1, height, width), np.uint8)
    z, flat = quantise_depth(surfaces.z[None], images)[0], (depth.reshape(count + 1, -1), region.reshape(count + 1, -1))
    paint_layers(surfaces.start, z, triangles.region[surfaces.face], *flat)
    drawn: dict[PixelKind, NDArray] = {}
    for n, name in enumerate([*(f"layer{layer}" for layer in LAYERS[:count]), "back"]):
        drawn |= {name: depth[n], f"{name}_region": region[n]}
    return drawn


def _parts_of(
    seen: Seen, thing: Placed, pixels: NDArray[np.int64]
) -> Iterator[tuple[Part, NDArray[np.int64], NDArray[np.int32], Array]]:
    """Each part that is seen: the pixels (flat numbers) that show it, and the corners and weights [N, 3] of what they show."""
    face, k = seen.triangles.face[seen.face.reshape(-1)[pixels]], seen.triangles.intrinsics
    seen_points = unproject(*np.divmod(pixels, k.width), seen.z.reshape(-1)[pixels], k)
    T_shape_cam, start = invert(thing.T_world_shape) @ seen.camera.T_world_cam, 0
    for part in thing.shape.parts:
        inside = np.flatnonzero((face >= start) & (face < start + len(part.faces)))
        if len(inside):
            points = transform(T_shape_cam, seen_points[inside])
            weighed = corner_weights(points, Mesh(part.vertices, part.faces), face[inside] - start)
            yield part, pixels[inside], *weighed
        start += len(part.faces)


_OF_SEEN: Mapping[str, Callable[[Seen, Targets], NDArray]] = {
    "normals": draw_normals,
    "coordinates": draw_coordinates,
    "albedo": draw_albedo,
    "covisible": draw_covisible,
}


def _sixteen_bits(share: Array) -> NDArray[np.uint16]:
    """Numbers from 0 to 1 as codes, to the nearest."""
    return np.rint(np.clip(share, 0.0, 1.0) * FULL).astype(np.uint16)
