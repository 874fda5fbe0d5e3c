"""For each effect a scene that calls for it, and what is there with the effect and gone without it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from schemas.errors import SceneError, SettleError
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_FLOOR, REGION_TABLE
from tests.effects.cases import ASKED, BEHIND, NO_OPS, RASTER, SURROUNDINGS, TARGETS, TRACED, WITHOUT_MIRROR
from tests.effects.physics_cases import PHYSICS
from tests.effects.physics_scenes import facts_with
from tests.effects.scenes import Made, Setting, make, without_textures
from tests.hard_cases.bodies import built_in, cube, mug_on_peg
from tests.hard_cases.drops import Drop, X, Y, drop, level, ring, turn

Outcome = Made | SceneError
Difference = Callable[[Outcome, Outcome], bool]
"""Whether the first outcome, with the effect, shows it, and the second, without the effect, does not."""


@dataclass(frozen=True, eq=False)
class Proof:
    """A scene that calls for an effect, and what its absence must change."""

    scene: Setting
    shows: Difference


def attempt(setting: Setting, *withdrawn: str) -> Outcome:
    """The scene as it is made with these effects taken out of its plan, or why it cannot be made."""
    try:
        return make(setting, withdrawn=withdrawn)
    except SceneError as error:
        return error


# ------------------------------------------------------------------------------------------- what is compared


def images(made: Outcome) -> dict[str, str]:
    assert isinstance(made, Made), made
    return {path: digest for path, digest in made.files.items() if not path.startswith("assets/")}


def same_as(other: Setting) -> Difference:
    """Without the effect the images are those of a scene that does not call for it; with it they are others."""
    return lambda present, absent: images(absent) == images(make(other)) != images(present)


def only_with(present: Callable[[Made], Any]) -> Difference:
    """Something of the scene is there with the effect and not without it."""
    return lambda shown, gone: (
        isinstance(shown, Made) and isinstance(gone, Made) and present(shown) and not present(gone)
    )


def sees(region: int) -> Difference:
    """A region has pixels in the input view."""
    return only_with(lambda made: region in set(np.asarray(made.scene.pairs[0].input.region).flat))


def rests(shown: Outcome, gone: Outcome) -> bool:
    """The object comes to rest with the effect alone; the renderer may not see what rests."""
    return not isinstance(shown, SettleError) and isinstance(gone, SettleError)


def colours(made: Outcome) -> np.ndarray:
    """[H, W, 3] int64 RGB of the input view."""
    assert isinstance(made, Made), made
    rgb = made.scene.pairs[0].input.rgb
    assert rgb is not None
    return rgb.astype(np.int64)


def adds_light(shown: Outcome, gone: Outcome) -> bool:
    """The effect adds light to a hundredth of the pixels or more, and takes it from a twentieth as many at most.

    Those are at edges, which the renderer finds by their colours.
    """
    gain = (colours(shown) - colours(gone)).sum(axis=2)
    brighter, darker = (gain > 0).mean(), (gain < 0).mean()
    return bool(brighter > 0.01 and darker <= 0.05 * brighter)


def takes_light(shown: Outcome, gone: Outcome) -> bool:
    """The effect takes light where another adds it."""
    return adds_light(gone, shown)


def changes_edges(shown: Outcome, gone: Outcome) -> bool:
    """The effect changes colours, 19 in 20 of them within two pixels of another region or of a step in depth of 25 mm."""
    changed = (colours(gone) != colours(shown)).any(axis=2)
    assert isinstance(shown, Made)
    view = shown.scene.pairs[0].input
    assert view.region is not None
    around = np.ones((5, 5), np.uint8)
    near = np.zeros(changed.shape, bool)
    for image, step in ((view.region, 0), (view.depth, 125)):
        near |= cv2.dilate(image, around).astype(int) - cv2.erode(image, around) > step
    return bool(changed.any() and near[changed].mean() > 0.95)


def changes_the_object_most(shown: Outcome, gone: Outcome) -> bool:
    """The effect changes the object's colours, and those of other pixels by less on the average."""
    assert isinstance(shown, Made)
    region = shown.scene.pairs[0].input.region
    assert region is not None
    change, objects = np.abs(colours(gone) - colours(shown)).mean(axis=2), region >= REGION_FIRST_OBJECT
    return bool(change[objects].mean() > 10.0 > change[~objects].mean())


def exact_views_agree(shown: Outcome, gone: Outcome) -> bool:
    """Noise of 7 mm from pixel to pixel leaves no smooth surface, and only smooth ones are compared: there is no figure."""
    assert isinstance(shown, Made) and isinstance(gone, Made)
    exact, blind = (made.scene.pairs[0].exact_agreement for made in (shown, gone))
    assert exact is not None and blind is not None and exact.scene_median_mm is not None
    return exact.scene_median_mm < 0.1 and blind.scene_median_mm is None and blind.median_mm is None


# ------------------------------------------------------------------------------------------- the proofs


def dropped(*drops: Drop, **changes: Any) -> Setting:
    """A scene of these objects, with their table, in the place of what is drawn; none is drawn again where one is lost."""
    return Setting({"start": {"if_lost": "fail"}, **changes}, lambda _: facts_with(*drops).plan)


def switched(name: str) -> Proof:
    """A switch of the job: without the effect the scene is as with the switch off."""
    return Proof(ASKED[name].needs, same_as(ASKED[name].spares))


ALL_SENSORS: dict[str, Any] = {
    "depth_noise": {}, "distortion": {"k1": -0.1}, "rgb_noise": {}, "exposure": {"stops": [1.0, 1.0]},
}  # fmt: skip


def one_sensor_less(name: str) -> Proof:
    others = {effect: branch for effect, branch in ALL_SENSORS.items() if effect != name}
    return Proof(Setting({"sensor": ALL_SENSORS}), same_as(Setting({"sensor": others})))


GLASS_BOTTLE = Setting(
    {
        "categories": ["bottle"],
        "render": {"tier": "pathtraced", "path_samples": 8},
        "cameras": {"sensor": {"fx": 400.0, "fy": 400.0}},
    },
    scene_id=1,
)
CHECKED = Setting({"check": {"raycast_share": 1.0}})

TUMBLED = {"start": {"pose": "tumbled"}}
"""A drop that tips over comes to rest millimetres away where it bounces; one that lands upright by less than a micrometre."""

PROOFS: dict[str, Proof] = {
    "dynamics": Proof(PHYSICS["dynamics"].needs, rests),
    "table_mesh": Proof(PHYSICS["table_mesh"].needs, only_with(lambda made: made.scene.settled[0].support == "mesh")),
    "object_contacts": Proof(
        dropped(drop(cube(), level()), drop(cube(), level(), 0.11)),
        only_with(lambda made: "object_contacts" not in made.scene.called),
    ),
    "decomposition": Proof(dropped(mug_on_peg()), rests),
    "fine_step": Proof(dropped(drop(cube(0.005), ring(0.001), 1.0, turn(X, 20), (0.45, 0.0))), rests),
    "rolling_friction": Proof(
        dropped(drop(built_in("bottle"), level(), R=turn(X, 60) @ turn(Y, 20)), physics={"max_settle_s": 1.5}), rests
    ),
    "restitution": Proof(Setting({**TUMBLED, "physics": {"restitution": 0.8}}), same_as(Setting(TUMBLED))),
    "depth_camera": switched("depth_camera"),
    "kept_poses": Proof(ASKED["kept_poses"].needs, rests),
    "mirror": Proof(Setting({}), same_as(Setting(WITHOUT_MIRROR))),
    "projection": switched("projection"),
    "splat": switched("splat"),
    "hidden_point_removal": switched("hidden_point_removal"),
    "rgb": switched("rgb"),
    "shadows": Proof(Setting(RASTER), takes_light),
    "ambient_occlusion": Proof(Setting(RASTER), takes_light),
    "antialiasing": Proof(Setting(RASTER), changes_edges),
    "samples": switched("samples"),
    "global_illumination": Proof(Setting(TRACED), adds_light),
    "glass": Proof(GLASS_BOTTLE, changes_the_object_most),
    **{f"sensor_{name}": one_sensor_less(name) for name in ALL_SENSORS},
    "raycast_check": Proof(CHECKED, only_with(lambda made: "raycast" in made.stopwatch.seconds)),
    "release_again": Proof(CHECKED, only_with(lambda made: made.scene.settled[0].recheck_move_mm is not None)),
    **{name: switched(name) for name in (*TARGETS, "further_views", "alpha")},
    **{name: Proof(ASKED[name].needs, same_as(Setting(BEHIND.get(name, {})))) for name in SURROUNDINGS},
    "floor": Proof(NO_OPS["floor"].needs, sees(REGION_FLOOR)),
    "table": Proof(NO_OPS["table"].needs, sees(REGION_TABLE)),
    "textures": Proof(NO_OPS["textures"].needs, same_as(Setting({}, without_textures))),
    "transparency": Proof(NO_OPS["transparency"].needs, same_as(Setting({}))),
    "light_maps": Proof(NO_OPS["light_maps"].needs, takes_light),
    "exact_agreement": Proof(NO_OPS["exact_agreement"].needs, exact_views_agree),
}
"""One for each effect there is."""
