"""The draw of a scene: assets, starts, cameras and look, all before anything moves.

Each step has a named stream of random numbers. Several objects begin each on a place of its own, or one above another.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.errors import StartError
from schemas.job.assets import SPLITS
from schemas.job.job import Job
from schemas.job.look import Clutter
from schemas.job.physics import Start
from schemas.scene.scene import Ground, ObjectStart, ScenePlan, Table
from schemas.scene.shape import REGION_FIRST_CLUTTER, REGION_FIRST_OBJECT, Asset, Hull, Mesh
from workers.assets.catalogue import Catalogue, InstanceRef, choose_object, choose_table, load_asset
from workers.assets.look.appearance import draw_appearance
from workers.assets.scene_tables import GivenScene
from workers.geometry.frames import UP, pose, rotation_about, transform, translation, uniform_rotation
from workers.geometry.hull import hull_of
from workers.physics.pour import Pouring, points_of
from workers.physics.support import columns_apart, place_table, sample_elevation, support_height, support_margin
from workers.scene.cameras import draw_camera
from workers.scene.chance import SceneChance, Stream
from workers.scene.draw.given import choose_given, put_alone, put_given, read_given
from workers.scene.draw.studio import draw_studio

MOST_REDRAWS = 20
"""Of a position that is not over the table or has no room, and of an object that was lost: hardly a scene needs five."""

MOST_DRAWS = 1000
"""Of an instance that is of no split, or of another than its scene's: a split of one instance in a hundred is then found."""

RECESS_M = 0.05
"""Table this far below its top still counts as table under an object: a tray's bottom does, a lower shelf does not."""

CONTACT_M = 5e-5
"""Distance below which a vertex touches the table."""


def plan_scene(job: Job, catalogue: Catalogue, chance: SceneChance) -> ScenePlan:
    """Everything about a scene that chance decides. Raises MeshError where an asset is unfit, StartError as `draw_scene`."""
    objects, table = choose_assets(job, catalogue, chance)
    assets = [load_asset(catalogue, ref) for ref in objects]
    given = read_given(job, catalogue, chance.scene_id)
    if job.scene == "studio":
        plan = draw_studio(job, chance, assets[0])
        return plan if given is None else put_alone(plan, job, given, assets[0])
    return draw_scene(job, chance, load_asset(catalogue, table), *assets, given=given)


def choose_assets(job: Job, catalogue: Catalogue, chance: SceneChance) -> tuple[list[InstanceRef], InstanceRef]:
    """The instances of a scene, before any is loaded: its objects in order, and its table.

    Where a job names the instances of splits, an object is drawn until it is of one, and each further object, with its category,
    until it is of the first one's. A table of scenes has them by name. Raises StartError where none of `MOST_DRAWS` is.
    """
    if (given := read_given(job, catalogue, chance.scene_id)) is not None:
        return choose_given(catalogue, chance, given)
    objects, split = list[InstanceRef](), job.assets.split
    fit = {*SPLITS}
    for number in range(count_objects(job, chance)):
        categories, instances = (chance.object_stream(name, number) for name in (Stream.CATEGORY, Stream.OBJECT))
        category = draw_category(job.categories, categories)
        for _ in range(MOST_DRAWS):
            ref = choose_object(catalogue, category, instances)
            if not split.named or split.of(ref.instance_id) in fit:
                break
            category = draw_category(job.categories, categories) if number else category
        else:
            wanted = f"none of {MOST_DRAWS} instances that were drawn, the last of {category}, is of {', '.join(sorted(fit))}"
            raise StartError("no_split", f"{wanted}: name more instances in assets.split.named")
        objects.append(ref)
        if split.named:
            fit = {split.of(ref.instance_id)}
    return objects, choose_table(catalogue, chance.stream(Stream.TABLE))


def count_objects(job: Job, chance: SceneChance) -> int:
    """How many objects the scene has."""
    low, high = job.objects_per_scene
    return low if low == high else int(chance.stream(Stream.COUNT).integers(low, high + 1))


def choose_category(job: Job, chance: SceneChance, number: int = 0) -> str:
    """The category that is drawn for an object by its number; the first one's is the scene's."""
    return draw_category(job.categories, chance.object_stream(Stream.CATEGORY, number))


def draw_category(categories: Mapping[str, float], rng: np.random.Generator) -> str:
    """A category by its weight."""
    names = sorted(categories)
    weights = np.array([categories[name] for name in names])
    edges = np.cumsum(weights) / weights.sum()
    return names[min(int(np.searchsorted(edges, rng.random(), side="right")), len(names) - 1)]


def draw_scene(
    job: Job, chance: SceneChance, table_asset: Asset, *assets: Asset, given: GivenScene | None = None
) -> ScenePlan:
    """Starts, cameras and look of a scene with these assets, or those `given`. Raises StartError where no start is valid."""
    table = place_table(table_asset)
    rng, further = chance.stream(Stream.CAMERA), chance.stream(Stream.ORBIT)
    centre = np.array([0.0, 0.0, table.top.height_m])
    floor, appearance = draw_appearance(chance.stream(Stream.APPEARANCE), job.render.tier)
    objects: tuple[ObjectStart, ...] = ()
    for asset in assets if given is None else ():
        objects += (draw_start(job.start, chance, asset, table, objects),)
    plan = ScenePlan(
        scene_id=chance.scene_id,
        category=assets[0].category,
        ground=Ground(table, floor),
        objects=objects,
        input_cameras=tuple(draw_camera(rng, further, job.cameras, centre) for _ in range(job.pairs_per_scene)),
        appearance=appearance,
    )
    return plan if given is None else put_given(plan, job, given, assets)


def add_clutter(job: Job, clutter: Clutter, catalogue: Catalogue, chance: SceneChance, plan: ScenePlan) -> ScenePlan:
    """The plan with clutter after its objects; what finds no room, or no instance of their split, is left out.

    Each piece has a stream of its own, so that no object and no other piece follows from how many there are.
    """
    split, (low, high), objects = job.assets.split, clutter.count, plan.objects
    weights = clutter.categories or job.categories
    of = split.of(objects[0].asset.instance_id)
    for number in range(int(chance.stream(Stream.CLUTTER).integers(low, high + 1))):
        rng = chance.stream(Stream.CLUTTER, number)
        drawn = (choose_object(catalogue, draw_category(weights, rng), rng) for _ in range(MOST_DRAWS))
        ref = next((ref for ref in drawn if not split.named or split.of(ref.instance_id) == of), None)
        if ref is None:
            continue
        asset, others = load_asset(catalogue, ref), [points_of(start) for start in objects]
        region = REGION_FIRST_CLUTTER + sum(start.is_clutter for start in objects)
        middle = objects[0].T_world_obj[:2, 3] if job.start.arrange == "pile" else np.zeros(2)
        with suppress(StartError):
            named = asset, region - REGION_FIRST_OBJECT
            objects += (_find_place(job.start, (rng, partial(_same, rng)), named, plan.table, others, middle),)
    return replace(plan, objects=objects)


def draw_start(
    spec: Start, chance: SceneChance, asset: Asset, table: Table, earlier: tuple[ObjectStart, ...] = ()
) -> ObjectStart:
    """Position, rotation and clearance of one object. Raises StartError where no position is valid.

    A position with no table under the centre of mass, or in the column of an earlier object, is redrawn. In a pile an
    object begins above all earlier ones, about the place of the first.
    """
    number = len(earlier)
    others = [points_of(start) for start in earlier]
    middle = earlier[0].T_world_obj[:2, 3] if earlier and spec.arrange == "pile" else np.zeros(2)
    rng = chance.object_stream(Stream.START, number)
    return _find_place(
        spec, (rng, lambda: chance.object_stream(Stream.REDRAW, number)), (asset, number), table, others, middle
    )


def pouring_of(spec: Start, chance: SceneChance, plan: ScenePlan) -> Pouring:
    """How the scene's objects are let go, and drawn again where they leave the table, each from its own stream.

    A pile's object then begins above all that have fallen, about the middle one of them; another on a place of its own.
    """
    piled = spec.arrange == "pile"

    def draw(start: ObjectStart, attempt: int, others: Sequence[Array]) -> ObjectStart:
        number = start.region_id - REGION_FIRST_OBJECT
        rng, middle = chance.stream(Stream.LOST, number, attempt), np.zeros(2)
        if piled and others:
            middle = np.median([(points.min(axis=0) + points.max(axis=0))[:2] / 2 for points in others], axis=0)
        again = _find_place(spec, (rng, lambda: rng), (start.asset, number), plan.table, others, middle)
        return replace(again, redraws=start.redraws + again.redraws + 1)

    return Pouring(piled, draw if spec.if_lost == "redraw" else None, MOST_REDRAWS, spec.if_lost == "remove")


def _same(rng: np.random.Generator) -> np.random.Generator:
    return rng


Streams = tuple[np.random.Generator, Callable[[], np.random.Generator]]
"""What a place is drawn from, and what makes the one that it is drawn again from."""


def _find_place(
    spec: Start, streams: Streams, of: tuple[Asset, int], table: Table, others: Sequence[Array], middle: Array
) -> ObjectStart:
    """The start of an asset, by its number, above or beside `others` (points [N, 3], world), about `middle` [2] in a pile."""
    (rng, redraw), (asset, number), piled = streams, of, bool(others) and spec.arrange == "pile"
    reach = spec.pile_offset_m if piled else spec.offset_m
    xy = middle + rng.uniform(reach.low, reach.high, size=2)
    yaw = rng.uniform(-math.pi, math.pi)
    clearance = rng.uniform(spec.clearance_m.low, spec.clearance_m.high)
    R = uniform_rotation(rng) if spec.pose == "tumbled" else rotation_about(UP, yaw)
    hull = hull_of(asset.shape)
    over_table, redraw_rng = False, None
    for redraws in range(MOST_REDRAWS + 1):
        com_xy = (R @ asset.mass.com)[:2] + xy
        if sample_elevation(com_xy[None, :], table.mesh)[0] >= table.top.height_m - RECESS_M:  # nan compares false
            over_table = True
            rested = set_down(pose(R, np.array([xy[0], xy[1], 0.0])), hull, table.mesh)
            points = transform(rested, hull.vertices)
            if piled or all(columns_apart(points, other) for other in others):
                # The lowest point of a pile's next object is at first level with the top of all earlier ones.
                lift = max(0.0, *(float(other[:, 2].max() - points[:, 2].min()) for other in others)) if piled else 0.0
                placed = spec.pose == "placed" and not piled and stands_on(rested, hull, asset.mass.com, table.mesh)
                T = rested if placed else translation(0.0, 0.0, lift + clearance) @ rested
                return ObjectStart(asset, hull, REGION_FIRST_OBJECT + number, frozen_array(T), redraws, placed)
        redraw_rng = redraw_rng or redraw()
        xy = middle + redraw_rng.uniform(reach.low, reach.high, size=2)
    raise _no_start(spec, number + 1, over_table)


def _no_start(spec: Start, number: int, over_table: bool) -> StartError:
    """Why no position was valid; `over_table` where at least one had table below."""
    if over_table:
        return StartError(
            "no_room",
            f"none of {MOST_REDRAWS + 1} positions in {list(spec.offset_m)} m had room for object {number} beside the "
            "others: widen start.offset_m, ask for fewer or smaller objects, or set "
            "start.arrange: pile",
        )
    return StartError(
        "no_table_below",
        f"none of {MOST_REDRAWS + 1} positions in {list(spec.offset_m)} m had table under the centre of mass: "
        "narrow start.offset_m or use larger tables",
    )


def set_down(T_world_obj: Pose, hull: Hull, table: Mesh) -> Pose:
    """The pose moved along z until its lowest point is level with the highest point of the table below it."""
    points = transform(T_world_obj, hull.vertices)
    return translation(0.0, 0.0, support_height(points[:, :2], table) - points[:, 2].min()) @ T_world_obj


def stands_on(T_world_obj: Pose, hull: Hull, com: Array, table: Mesh) -> bool:
    """Whether the centre of mass [3] lies inside the hull of the vertices that touch the table."""
    points = transform(T_world_obj, hull.vertices)
    gap_m = points[:, 2] - sample_elevation(points[:, :2], table)
    contacts = points[np.isfinite(gap_m) & (np.abs(gap_m) <= CONTACT_M)]
    return support_margin(contacts[:, :2], transform(T_world_obj, com[None, :])[0, :2]) > 0.0
