"""Image targets of stored scenes by their definitions: at each pixel's centre, from the stored shapes and poses (rays.py).

normals, coordinates and albedo are of the nearest surface of the thing that the mask shows; covisible is whether a ray from the
input camera meets that first; amodal and layers are of all surfaces of objects, seen from either side. Where a centre is near a
projected edge, any choice of the faces there is right in which every closed body is met an even number of times. The mask of a
capture is a photograph's, and its object the merged mesh: where that has a hole, nothing is right.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from services.read.independent.derive import (
    FIRST_CLUTTER,
    FIRST_OBJECT,
    FLOOR,
    TABLE,
    Array,
    Kind,
    Row,
    StoredPair,
    faces_of,
    matrix,
    name_of,
    of_objects,
    on_walls,
)
from services.read.independent.rays import (
    BEHIND_M,
    Faces,
    Hits,
    cast,
    choices,
    on_edges,
    seen_by,
)

STEP = 1.0 / 65_535.0
"""Of images of 16 bits."""

MOST_DEG, MOST_SHARE, MOST_CODES, MOST_MM = 0.02, 2e-5, 1.0, 0.02
"""Largest errors: of a normal, beyond rounding; of a coordinate, of the box's diagonal; of albedo, in codes before rounding; of a
layer, beyond half a unit of stored depth."""

COVISIBLE_PIXELS = 1_000
"""Pixels at edges of a mask `covisible`, and of objects elsewhere, that are judged at most."""

MOST_UNSURE = 12
"""A pixel near the edges of more faces, as at the pole of a sphere, is not judged where the exact answer is not stored."""

ENOUGH_WRONG = 40
"""After so many wrong pixels of an image, all others without the exact answer count as wrong."""


@dataclass(frozen=True)
class Finding:
    """One target of one view.

    pixels: judged ones whose rays meet something, beside all others, which must be 0; wrong, and the first (column, row) of
    them; worst: the largest error in `unit` away from edges.
    """

    target: str
    unit: str
    pixels: int
    wrong: int
    first: tuple[int, int]
    worst: float


def check_targets(pair: StoredPair, view: Row) -> Iterator[str]:
    """Images and columns of targets that differ from their definitions, a sentence each; none where a shape is in no file."""
    if pair.is_captured and not pair.targets["views"]:
        return
    try:
        faces = faces_of(pair, view)
    except FileNotFoundError as error:
        pair.absent.append(error.filename or str(error))
        return
    if pair.targets["views"]:
        yield from _check_columns(pair, view)
    for finding in judge_images(pair, view, faces):
        pair.findings.append(finding)
        if finding.wrong:
            at = f"pixel {finding.first} is the first, the worst away from edges is {finding.worst:.3g} {finding.unit}"
            yield f"{finding.target}: {finding.wrong} of {finding.pixels} pixels are not what the shapes show: {at}"


def _check_columns(pair: StoredPair, view: Row) -> Iterator[str]:
    """Extents and shares against their images, scale and offset of coordinates against the boxes of the shapes."""
    rows = pair.labels(view)
    asked, shapes = pair.targets["views"], {body["region_id"]: body for body in pair.bodies}
    for region, row in rows.items():
        expected: dict[str, object] = {"amodal_pixels": None, "amodal_bbox_xywh": None, "targets_share": None}
        mask = pair.images.get((name_of(view), f"amodal{region}"))
        if mask is not None:
            expected |= {"amodal_pixels": np.count_nonzero(mask), "amodal_bbox_xywh": list(cv2.boundingRect(mask))}
        own = pair.images[name_of(view), "region"] == region
        for name in ("normals", "coordinates") if pair.is_captured and region >= FIRST_OBJECT and own.any() else ():
            if name in asked:
                there = pair.images[name_of(view), name][own].any(axis=1)
                expected["targets_share"] = np.count_nonzero(there) / len(there)
        for name, value in expected.items():
            if row[name] != value:
                yield f"region {region}: {name} is {row[name]}, its image gives {value}"
        stored = row["coordinates_scale_m"], row["coordinates_offset_m"]
        if region < FIRST_OBJECT or "coordinates" not in asked:
            if stored != (None, None):
                yield f"region {region}: it has coordinates' scale and offset, and no such image"
            continue
        body = shapes[region]
        points = pair.shapes[f"assets/{body['category']}/{body['instance_id']}.glb"].points.reshape(-1, 3)
        low, high = points.min(axis=0), points.max(axis=0)
        diagonal = float(np.linalg.norm(high - low))
        offset = (low + high) / 2.0 - diagonal / 2.0
        if not np.allclose([stored[0], *stored[1]], [diagonal, *offset], rtol=0.0, atol=1e-6 * diagonal):
            yield f"region {region}: coordinates' scale and offset are {stored}, its shape gives {diagonal}, {offset}"


def judge_images(pair: StoredPair, view: Row, faces: Faces) -> list[Finding]:
    """A finding for each target of a view that the job asks for, and one of its depth and regions; `faces` as of `faces_of`."""
    hits, asked = cast(faces, view), pair.targets["views"]
    region = pair.images[name_of(view), "region"].reshape(-1)
    own = hits.where(faces.region[hits.face] == region[hits.pixel])
    seen = (kind for kind in pair.kinds(view["role"]).values() if kind.formula is not None)
    findings = [_judge_seen(kind, pair, view, faces, own) for kind in seen]
    objects = hits.where(of_objects(faces.region[hits.face]))
    if "covisible" in pair.kinds(view["role"]):
        findings.append(_judge_covisible(pair, view, own))
    if "amodal" in asked:
        findings += [_judge_amodal(pair, view, faces, objects, number) for number in pair.regions]
    if "layers" in asked:
        findings.append(_judge_layers(pair, view, faces, objects))
    if not pair.is_captured:
        findings.append(_judge_nearest(pair, view, faces, hits))
    return findings


@dataclass(frozen=True, eq=False)
class _Exact:
    """An image beside the exact answer, each [P]: judged pixels, bad ones of them, and how far they are off, in `unit`."""

    target: str
    unit: str
    judged: NDArray[np.bool_]
    bad: NDArray[np.bool_]
    off: Array


def _settle(exact: _Exact, view: Row, faces: Faces, hits: Hits, fits: Callable[[int, Hits], bool]) -> Finding:
    """The finding of an image: pixels without the exact answer are right where one of the `choices` of their hits fits."""
    met, edge = np.zeros((2, len(exact.judged)), bool)
    met[hits.pixel] = True
    edge[hits.pixel[~hits.sure]] = True
    wrong = list[int]()
    for pixel in np.flatnonzero(exact.bad).tolist():
        start, stop = np.searchsorted(hits.pixel, [pixel, pixel + 1])
        there = hits.where(slice(start, stop))
        is_judged = np.count_nonzero(~there.sure) <= MOST_UNSURE
        if len(wrong) >= ENOUGH_WRONG or (
            is_judged and not any(fits(pixel, there.where(some)) for some in choices(faces, there))
        ):
            wrong.append(pixel)
    row, column = divmod(wrong[0], view["width"]) if wrong else (-1, -1)
    pixels, worst = int(np.count_nonzero(exact.judged & met)), exact.off[exact.judged & ~edge].max(initial=0.0)
    return Finding(exact.target, exact.unit, pixels, len(wrong), (column, row), float(worst))


def _judge_seen(kind: Kind, pair: StoredPair, view: Row, faces: Faces, own: Hits) -> Finding:
    """A target of what is seen; `own`: hits of the thing that the mask shows."""
    region = pair.images[name_of(view), "region"].reshape(-1)
    stored = pair.images[name_of(view), kind.name].reshape(-1, kind.channels)
    assert kind.formula is not None
    least, unit, answer = _ANSWERS[kind.formula]
    shown = region >= least
    if kind.formula == "albedo" and np.isnan(faces.colors[faces.region == FLOOR]).any():
        shown &= region != FLOOR
    if kind.formula == "albedo" and pair.surroundings.get("table"):
        shown &= region != TABLE
    shown &= ~on_walls(pair, view).reshape(-1)
    judged = shown | (region < least)
    if least == FIRST_OBJECT:
        shown &= region < FIRST_CLUTTER
    off = np.where(stored.any(axis=1), np.inf, 0.0)
    if not pair.is_captured:
        off[shown] = np.inf
    covers = own.where(own.covers & shown[own.pixel])
    nearest = covers.where(np.unique(covers.pixel, return_index=True)[1])
    nearest = replace(nearest, low=nearest.z, high=nearest.z)
    off[nearest.pixel], most = answer(pair, view, faces, nearest, stored[nearest.pixel])
    limit = np.zeros(len(off))
    limit[nearest.pixel] = most

    def fits(pixel: int, hits: Hits) -> bool:
        if pair.is_captured and not len(hits.z):
            return not stored[pixel].any()
        first = hits.where(hits.low <= hits.high.min(initial=np.inf))
        error, most = answer(pair, view, faces, first, np.repeat(stored[pixel][None], len(first.z), axis=0))
        return bool((error <= most).any()) and bool(shown[pixel])

    return _settle(_Exact(kind.name, unit, judged, judged & (off > limit), off), view, faces, own, fits)


def _rays(view: Row, hits: Hits) -> Array:
    """[N, 3]: rays with z = 1 through the centres of the hits' pixels."""
    row, column = np.divmod(hits.pixel, view["width"])
    x, y = (column + 0.5 - view["cx"]) / view["fx"], (row + 0.5 - view["cy"]) / view["fy"]
    return np.stack([x, y, np.ones(len(x))], axis=1)


def _levels(hits: Hits) -> Array:
    """[1 or 3, N, 1]: the least, middle and largest right z of each hit; one where they are equal."""
    return (hits.z[None] if np.array_equal(hits.low, hits.high) else np.stack([hits.low, hits.z, hits.high]))[..., None]


def _weights(view: Row, faces: Faces, hits: Hits) -> Array:
    """[1 or 3, N, 3]: with which corners of its face add up to a hit, at the z of `_levels`; beyond a face, to its edges."""
    points = _rays(view, hits) * _levels(hits)
    corners = faces.points[hits.face]
    a, b, c = corners.swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    shares = [(np.cross(v - points, w - points) * normal).sum(axis=2) for v, w in ((b, c), (c, a), (a, b))]
    weights = np.stack(shares, axis=2) / np.maximum((normal * normal).sum(axis=1), 1e-300)[:, None]
    beyond = (weights < 0.0).any(axis=2) | (weights.sum(axis=2) < 0.5)
    weights[beyond] = on_edges(points[beyond], corners[np.nonzero(beyond)[1]])
    return weights


def _beyond(answers: Array, stored: Array) -> Array:
    """[N, C]: how far stored values are outside of the answers [S, N, C] at several places of a hit."""
    return np.maximum(np.maximum(answers.min(axis=0) - stored, stored - answers.max(axis=0)), 0.0)


def _normals(pair: StoredPair, view: Row, faces: Faces, hits: Hits, stored: NDArray) -> tuple[Array, Array]:
    """(errors [N], largest right ones [N]), degrees: of (n + 1) / 2, n the unit normal towards the camera."""
    planes, heights = (each[hits.face] for each in faces.plane_normals)
    rays = _rays(view, hits)
    planes = planes * np.where((planes * rays).sum(axis=1) > 0.0, -1.0, 1.0)[:, None]
    answers = planes[None]
    if pair.targets["smooth"]:
        answers = np.einsum("snc,nck->snk", _weights(view, faces, hits), faces.normals[hits.face])
        answers = answers / np.maximum(np.linalg.norm(answers, axis=2, keepdims=True), 1e-12)
        answers = answers * np.where((answers * planes).sum(axis=2, keepdims=True) < 0.0, -1.0, 1.0)
    apart = np.linalg.norm(_beyond(answers, stored * (2.0 * STEP) - 1.0), axis=1)
    turned = 2.0 * faces.rounding_m[hits.face] / np.maximum(heights, 1e-12)
    return np.degrees(apart), MOST_DEG + np.degrees(np.sqrt(3.0) * STEP + turned)


def _coordinates(pair: StoredPair, view: Row, faces: Faces, hits: Hits, stored: NDArray) -> tuple[Array, Array]:
    """The same as shares of the box's diagonal: coordinates_scale_m * value / 65535 + coordinates_offset_m is the point."""
    error = np.zeros(len(hits.z))
    region, rays = faces.region[hits.face], _rays(view, hits)
    for row in (row for number, row in pair.labels(view).items() if number >= FIRST_OBJECT):
        own = region == row["region_id"]
        T_obj_cam, some = np.linalg.inv(matrix(row, "T_cam_obj")), hits.where(own)
        points = rays[own] * _levels(some)
        points_stored = row["coordinates_scale_m"] * (stored[own] * STEP) + row["coordinates_offset_m"]
        error[own] = _beyond(points @ T_obj_cam[:3, :3].T + T_obj_cam[:3, 3], points_stored).max(axis=1, initial=0.0)
        error[own] /= row["coordinates_scale_m"]
    return error, np.full(len(error), MOST_SHARE)


def _albedo(pair: StoredPair, view: Row, faces: Faces, hits: Hits, stored: NDArray) -> tuple[Array, Array]:
    """The same in codes of sRGB: base colour, vertex colour and texture (bilinear, repeated), multiplied in linear light."""
    weights = _weights(view, faces, hits)
    light = np.einsum("snc,nck->snk", weights, faces.colors[hits.face])
    uv = np.einsum("snc,nck->snk", weights, faces.uv[hits.face])
    for number, texture in enumerate(faces.textures):
        own = faces.texture[hits.face] == number
        light[:, own] *= _sample(texture, uv[:, own])
    light = np.clip(light, 0.0, 1.0)
    codes = 255.0 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    error = _beyond(codes, stored).max(axis=1, initial=0.0)
    return error, np.full(len(error), MOST_CODES)


def _sample(texture: Array, uv: Array) -> Array:
    height, width = texture.shape[:2]
    x, y = uv[..., 0] * width - 0.5, uv[..., 1] * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    light = np.zeros((*uv.shape[:-1], 3))
    for right, down in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = np.abs(1 - right - (x - left)) * np.abs(1 - down - (y - top))
        light += share[..., None] * texture[(top + down) % height, (left + right) % width]
    return light


_ANSWERS: dict[str, tuple[int, str, Callable[[StoredPair, Row, Faces, Hits, NDArray], tuple[Array, Array]]]] = {
    "normals": (FLOOR, "degrees", _normals),
    "coordinates": (FIRST_OBJECT, "of the diagonal", _coordinates),
    "albedo": (FLOOR, "codes", _albedo),
}
"""Formulas that rows of modalities name: least region that has it, the unit of its errors, and what they are."""


def _judge_covisible(pair: StoredPair, view: Row, own: Hits) -> Finding:
    """255 where the input camera sees the point of an object, 0 elsewhere: judged at some pixels, against every face there is.

    As many at edges of the mask as of objects elsewhere, evenly by number; not those near an edge in this view, see `seen_by`.
    """
    mask, first, around = pair.images[name_of(view), "covisible"], pair.views["input"], np.ones((3, 3), np.uint8)
    shown = of_objects(pair.images[name_of(view), "region"])
    beside = shown & (cv2.dilate(mask * shown, around) != cv2.erode(np.where(shown, mask, 255), around))
    chosen = [np.flatnonzero(some) for some in (beside, shown & ~beside)]
    pixels = np.sort(np.concatenate([some[:: len(some) // COVISIBLE_PIXELS + 1] for some in chosen]))
    nearest = own.where(np.searchsorted(own.pixel, pixels[np.isin(pixels, own.pixel)]))
    nearest = nearest.where(nearest.sure & (nearest.high - nearest.low < BEHIND_M))
    T = np.linalg.inv(matrix(first, "T_world_cam")) @ matrix(view, "T_world_cam")
    points = (_rays(view, nearest) * nearest.z[:, None]) @ T[:3, :3].T + T[:3, 3]
    answers = seen_by(first, faces_of(pair, first), points, nearest.face, T[:3, 3])
    differ = (answers >= 0) & (answers * 255 != mask.reshape(-1)[nearest.pixel])
    wrong = np.union1d(nearest.pixel[differ], np.flatnonzero((mask != 0) & ~(shown & (mask == 255))))
    row, column = divmod(int(wrong[0]), view["width"]) if len(wrong) else (-1, -1)
    return Finding("covisible", "of 255", len(pixels), len(wrong), (column, row), float(len(wrong) > 0))


def _judge_amodal(pair: StoredPair, view: Row, faces: Faces, objects: Hits, number: int) -> Finding:
    """255 where a ray meets the object, whatever is in front of it, and else 0."""
    mask = pair.images[name_of(view), f"amodal{number}"].reshape(-1)
    own = objects.where(faces.region[objects.face] == number)
    expected = np.zeros(len(mask), mask.dtype)
    expected[own.pixel[own.covers]] = 255
    bad = mask != expected
    exact = _Exact("amodal", "of 255", np.ones(len(mask), bool), bad, bad.astype(float))
    return _settle(exact, view, faces, own, lambda pixel, hits: bool(mask[pixel] == 255 * (len(hits.z) > 0)))


def _judge_layers(pair: StoredPair, view: Row, faces: Faces, objects: Hits) -> Finding:
    """Depth and region of the first surfaces of objects along each ray, and of the last."""
    names = [*(f"layer{n}" for n in range(1, pair.targets["layers"] + 1)), "back"]
    depth, region = (
        np.stack([pair.images[name_of(view), f"{name}{what}"].reshape(-1) for name in names])
        for what in ("", "_region")
    )
    covers = objects.where(objects.covers)
    start = np.searchsorted(covers.pixel, np.arange(depth.shape[1] + 1))
    nth = np.concatenate([start[:-1] + np.arange(len(names) - 1)[:, None], start[None, 1:] - 1])
    there = (nth >= start[:-1]) & (nth < start[1:])
    of = nth[there]
    fits, off = ~(depth.astype(bool) | region.astype(bool)), np.zeros(depth.shape)
    right, off[there] = _fits_depth(pair, view, depth[there], covers.low[of], covers.high[of])
    fits[there] = right & (region[there] == faces.region[covers.face[of]])

    def fits_choice(pixel: int, hits: Hits) -> bool:
        low, high, count = np.sort(hits.low), np.sort(hits.high), len(hits.z)
        for layer, n in enumerate([*range(len(names) - 1), count - 1]):
            if not 0 <= n < count:
                if depth[layer, pixel] or region[layer, pixel]:
                    return False
                continue
            near = (hits.low <= high[n]) & (hits.high >= low[n])
            if not _fits_depth(pair, view, depth[layer, pixel], low[n], high[n])[0]:
                return False
            if region[layer, pixel] not in faces.region[hits.face[near]]:
                return False
        return True

    exact = _Exact("layers", "mm", np.ones(depth.shape[1], bool), ~fits.all(axis=0), off.max(axis=0))
    return _settle(exact, view, faces, objects, fits_choice)


def _judge_nearest(pair: StoredPair, view: Row, faces: Faces, hits: Hits) -> Finding:
    """Region and depth of the nearest surface along each ray, whatever it is of. A floor beyond stored depth may have an end."""
    region, depth = (pair.images[name_of(view), name].reshape(-1) for name in ("region", "depth"))
    far_m, noisy = pair.job["images"]["depth_range_m"][1], bool(pair.job["sensor"]["depth_noise"])

    def fits(pixel: int | NDArray, there: Hits) -> tuple[NDArray[np.bool_], Array]:
        of, (right, off) = faces.region[there.face], _fits_depth(pair, view, depth[pixel], there.low, there.high)
        ends = (of == FLOOR) & (there.high > far_m) & (region[pixel] == 0) & (depth[pixel] == 0)
        return ((of == region[pixel]) & (right | noisy)) | ends, np.zeros(len(off)) if noisy else off

    def fits_choice(pixel: int, there: Hits) -> bool:
        first = there.where(there.low <= there.high.min(initial=np.inf))
        return bool(fits(pixel, first)[0].any()) if len(first.z) else not region[pixel]

    covers = hits.where(hits.covers)
    nearest = covers.where(np.unique(covers.pixel, return_index=True)[1])
    right, off = (region == 0) & (depth == 0), np.zeros(len(region))
    right[nearest.pixel], off[nearest.pixel] = fits(nearest.pixel, nearest)
    judged = ~on_walls(pair, view).reshape(-1)
    exact = _Exact("depth and region", "mm", judged, judged & ~right, off)
    return _settle(exact, view, faces, hits, fits_choice)


def _fits_depth(
    pair: StoredPair, view: Row, stored: NDArray, low: Array, high: Array
) -> tuple[NDArray[np.bool_], Array]:
    """(whether stored depth is right for a z from low to high, by how many millimetres it is off beyond half a unit)."""
    units, (least, most) = view["depth_units_per_m"], pair.job["images"]["depth_range_m"]
    off = np.maximum(np.maximum(low - stored / units, stored / units - high) - 0.5 / units, 0.0) * 1e3
    unstored = (low <= least + MOST_MM / 1e3) | (high >= most - MOST_MM / 1e3)
    storable = (high >= least - MOST_MM / 1e3) & (low <= most + MOST_MM / 1e3)
    right = np.where(stored > 0, (off <= MOST_MM) & storable, unstored)
    return right, np.where(stored > 0, off, np.where(unstored, 0.0, np.inf))
