"""What `look` puts around the objects of a scene that is planned, from streams of its own, so that nothing else moves."""

import math
from collections.abc import Mapping
from dataclasses import replace

from schemas.job.job import Job
from schemas.job.look import Look, Surface
from schemas.scene.scene import ScenePlan, Walls
from schemas.scene.shape import Appearance, Shape
from workers.assets.catalogue import Catalogue
from workers.assets.look.environment import relight
from workers.assets.look.lights import describe_lights, draw_environment, draw_lights
from workers.assets.look.pictures import load_picture
from workers.assets.look.surroundings import Coat, build_room, cover_floor, cover_table, draw_coat, require_inside
from workers.scene.chance import SceneChance, Stream
from workers.scene.draw.plan import add_clutter

FLOOR, TABLE, BACKGROUND, ROOM = range(4)
"""Parts of the stream of surroundings."""

ROUGH, SMOOTH = 0.9, 0.8
"""Roughness of a floor's cover and of a table's: neither has highlights."""


def surround(job: Job, look: Look, catalogue: Catalogue, chance: SceneChance, plan: ScenePlan) -> ScenePlan:
    """The plan with covers of floor and table, a room and what is behind everything, as far as they are asked for.

    Raises StartError where the table does not fit into the room.
    """
    appearance, drawn = light_scene(look, catalogue, chance, plan.appearance, plan.ground is not None)
    plan = replace(plan, appearance=appearance)
    if plan.ground is not None:
        ground = plan.ground
        floor, walls, around = enclose(look, catalogue, chance, ground.floor, appearance)
        drawn |= around
        if walls is not None:
            require_inside(walls, "table", ground.table.mesh.vertices)
        ground = replace(ground, floor=floor, walls=walls)
        if look.table is not None:
            rng, pictures = chance.stream(Stream.SURROUNDINGS, TABLE), catalogue.pictures.get("look.table.folder", ())
            coat = draw_coat(look.table, pictures, rng, SMOOTH)
            drawn |= _named("table", coat)
            ground = replace(ground, cover=cover_table(ground.table.asset, coat))
        plan = replace(plan, ground=ground)
        if look.clutter is not None:
            plan = add_clutter(job, look.clutter, catalogue, chance, plan)
    if look.background is not None:
        pictures = catalogue.pictures["look.background"]
        picture = pictures[int(chance.stream(Stream.SURROUNDINGS, BACKGROUND).integers(len(pictures)))]
        drawn["background"] = picture.name
        plan = replace(plan, appearance=replace(plan.appearance, backdrop=load_picture(picture)))
    return replace(plan, surroundings=drawn) if drawn or look.clutter is not None else plan


def light_scene(
    look: Look, catalogue: Catalogue, chance: SceneChance, base: Appearance, shown: bool
) -> tuple[Appearance, dict[str, object]]:
    """The appearance in the light that is asked for, and what was drawn of it. `shown`: as of `relight`."""
    lights, around, drawn = None, None, dict[str, object]()
    if look.lights is not None:
        lights = draw_lights(chance.stream(Stream.LIGHTS), look.lights)
        drawn["lights"] = describe_lights(lights)
    if look.environment is not None:
        around = draw_environment(chance.stream(Stream.ENVIRONMENT), look.environment, catalogue.maps)
        drawn |= {"environment": around.source.name, "environment_deg": math.degrees(around.turn_rad)}
    return relight(base, lights, around, shown), drawn


def enclose(
    look: Look, catalogue: Catalogue, chance: SceneChance, floor: Shape, appearance: Appearance
) -> tuple[Shape, Walls | None, dict[str, object]]:
    """The floor and the room that are asked for, with its window towards the key light, and what was drawn of both."""
    walls, drawn = None, dict[str, object]()
    if look.floor is not None:
        floor, coat = lay_floor(look.floor, catalogue, chance, floor)
        drawn |= _named("floor", coat)
    if look.room is not None:
        walls = build_room(look.room, appearance.lights[0].direction, chance.stream(Stream.SURROUNDINGS, ROOM))
        drawn["room_m"] = walls.size_m.tolist()
    return floor, walls, drawn


def lay_floor(surface: Surface, catalogue: Catalogue, chance: SceneChance, floor: Shape) -> tuple[Shape, Coat]:
    """The floor as a scene has it, and what it is covered with."""
    rng = chance.stream(Stream.SURROUNDINGS, FLOOR)
    coat = draw_coat(surface, catalogue.pictures.get("look.floor.folder", ()), rng, ROUGH)
    return cover_floor(floor, coat), coat


def _named(key: str, coat: Coat) -> Mapping[str, object]:
    tile = None if coat.material.texture is None else float(coat.tile_m[0])
    return {key: coat.name, f"{key}_tile_m": tile}
