"""Two scenes for each effect: one that needs it and one that does not. An entry of `EFFECTS` without its case fails.

Effects of physics have theirs in physics_cases.py.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from schemas.job.look import OFF
from schemas.job.views import ViewTarget
from tests.effects.scenes import (
    ABOVE_THE_HORIZON,
    Setting,
    above_the_table,
    merged,
    with_holes,
    without_textures,
)

TARGETS: tuple[str, ...] = get_args(ViewTarget)


@dataclass(frozen=True, eq=False)
class Case:
    """`needs` calls for the effect; `spares` does not, and `why` is the plan's reason."""

    needs: Setting
    spares: Setting
    why: str


def _asked(on: Mapping[str, Any], off: Mapping[str, Any], why: str) -> Case:
    return Case(Setting(on), Setting(off), why)


def _sensor(name: str, **branch: Any) -> Case:
    return _asked({"sensor": {name: branch}}, {}, f"sensor.{name} is off")


def _target(name: str) -> Case:
    """Asked for beside another target, and that target alone: a job without any has none in its receipt."""
    other = next(one for one in TARGETS if one != name)
    views = {"views": [other, name]}, {"views": [other]}
    return _asked({"targets": views[0]}, {"targets": views[1]}, f"targets.views has no {name}")


def _look(name: str, branch: str, value: Any) -> Case:
    """Asked for; not where another branch is asked for."""
    other = {"floor": {"colours": [RED]}} if branch != "floor" else {"table": {"colours": [RED]}}
    usual = OFF.get(branch, "off")
    return _asked(
        {**BEHIND.get(name, {}), "look": {branch: value}},
        {"look": {"recolour": "as_made", **other}},
        f"look.{branch} is {usual}",
    )


RED, BLUE = (0.8, 0.1, 0.1), (0.1, 0.1, 0.8)

BEHIND = {"backdrop": ABOVE_THE_HORIZON}
"""Keys of a scene in which the effect is seen, where any other scene does not show it."""

PICTURES = str(Path(__file__).parents[2] / "docs" / "images")

SURROUNDINGS: dict[str, tuple[str, Any]] = {
    "recolour": ("recolour", {"hue": [[0.6, 0.65]]}),
    "floor_cover": ("floor", {"colours": [RED]}),
    "table_cover": ("table", {"colours": [BLUE]}),
    "backdrop": ("background", PICTURES),
    "room": ("room", {"size_m": [4.5, 5.0]}),
    "clutter": ("clutter", {"count": 2}),
    "lights": ("lights", {}),
    "environment": ("environment", {"built_in": ["softboxes"]}),
}

NOISY = {
    "sensor": {"depth_noise": {}},
    "cameras": {"sensor": {"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 320.0, "cy": 240.0}},
}
FLAT, RASTER = {"render": {"tier": "flat"}}, {"render": {"tier": "raster"}}
TRACED = {"render": {"tier": "pathtraced", "path_samples": 1}, "categories": ["jar"]}

WITHOUT_MIRROR = {"cameras": {"mirror": {"enabled": False}}, "images": {"projection": {"enabled": False}}}

STUDIO: dict[str, Any] = {"scene": "studio"}
FRAMED: dict[str, Any] = {"cameras": {"orbit": {"radius_m": 1.0}}}
AROUND: dict[str, Any] = {"cameras": {"more": [{"name": "around", "ring": {"count": 3}}]}}

ASKED: dict[str, Case] = {
    "depth_camera": _asked({}, {"cameras": {"depth": {"enabled": False}}}, "cameras.depth.enabled is false"),
    "mirror": _asked({}, WITHOUT_MIRROR, "cameras.mirror.enabled is false"),
    "projection": _asked({}, {"images": {"projection": {"enabled": False}}}, "images.projection.enabled is false"),
    "restitution": _asked({"physics": {"restitution": 0.8}}, {}, "physics.restitution is 0"),
    "rgb": _asked({}, {"render": {"rgb": False}}, "render.rgb is false"),
    "splat": _asked({"images": {"projection": {"splat": 3}}}, {}, "images.projection.splat is 1"),
    "hidden_point_removal": _asked(
        {"images": {"projection": {"hidden_point_removal": True}}}, {}, "images.projection.hidden_point_removal is off"
    ),
    "shadows": _asked(RASTER, FLAT, "render.tier is flat"),
    "ambient_occlusion": _asked(RASTER, FLAT, "render.tier is flat"),
    "antialiasing": _asked(RASTER, FLAT, "render.tier is flat"),
    "samples": _asked({"render": {"samples": 4}}, {}, "render.samples is 1"),
    "global_illumination": _asked(TRACED, {**TRACED, **RASTER}, "render.tier is raster"),
    "glass": Case(Setting({**TRACED, "categories": ["bottle"]}, scene_id=1), Setting(TRACED), "no surface is of glass"),
    "sensor_depth_noise": _sensor("depth_noise"),
    "sensor_distortion": _sensor("distortion", k1=-0.1),
    "sensor_rgb_noise": _sensor("rgb_noise"),
    "sensor_exposure": _sensor("exposure", stops=[1.0, 1.0]),
    "raycast_check": _asked({"check": {"raycast_share": 1.0}}, {}, "not in the share check.raycast_share"),
    "release_again": _asked({"check": {"raycast_share": 1.0}}, {}, "not in the share check.raycast_share"),
    **{name: _target(name) for name in TARGETS},
    "further_views": _asked({**STUDIO, **merged(FRAMED, AROUND)}, {**STUDIO, **FRAMED}, "cameras.more is empty"),
    **{name: _look(name, branch, value) for name, (branch, value) in SURROUNDINGS.items()},
    "alpha": _asked(
        {**STUDIO, **FRAMED},
        {**STUDIO, **FRAMED, "studio": {"background": [0.0, 0.0, 0.0]}},
        "studio.background is a colour",
    ),
    "kept_poses": _asked(
        {"scenes_from": above_the_table(settle=False)},
        {"scenes_from": above_the_table(settle=True)},
        "settle is true: objects fall from there",
    ),
}

OF_OTHERS = {*TARGETS, *SURROUNDINGS, "further_views", "alpha", "kept_poses"}
"""Effects that the receipt of a job does not name which has nothing of their kind."""

NO_OPS: dict[str, Case] = {
    "floor": Case(Setting({}), Setting(ABOVE_THE_HORIZON), "outside of every view"),
    "table": Case(Setting({}), Setting(ABOVE_THE_HORIZON), "outside of every view"),
    "textures": Case(Setting({}), Setting({}, without_textures), "no surface has a texture"),
    "transparency": Case(Setting({}, with_holes), Setting({}), "no texture has clear texels"),
    "light_maps": Case(Setting(RASTER), Setting(FLAT), "render.tier is flat"),
    "exact_agreement": Case(Setting(NOISY), Setting({}), "stored depth is exact: sensor.depth_noise is off"),
}
