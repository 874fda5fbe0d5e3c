"""The images of a scene with each setting, held against what rays and very many paths say."""

from collections.abc import Sequence

from schemas.errors import SceneError
from services.tradeoff.colour_errors import colour_truth_missing, converged_colour, flip_error
from services.tradeoff.image_errors import measure_images
from services.tradeoff.model import Setting
from services.tradeoff.settling import context_for
from services.tradeoff.truth import truth_of
from workers.context import WorkerContext
from workers.scene_steps import Scene, Stopwatch, make_scene

CONVERGED_PATHS = 256


def measure_pictures(context: WorkerContext, settings: Sequence[Setting], scene_id: int) -> dict[str, dict[str, float]]:
    """Errors of depth, masks, the mirror pose and the projection by the settings' names, where the scene can be made."""
    truth, answers = None, {}
    for setting in settings:
        found = _make(context_for(context, setting), scene_id)
        if found is not None:
            truth = truth_of(found[1], truth)
            answers[setting.name] = measure_images(*found, truth)
    return answers


def measure_colour(context: WorkerContext, settings: Sequence[Setting], scene_id: int) -> dict[str, dict[str, float]]:
    """FLIP of the input RGB by the settings' names; nothing where the path-traced tier is not installed."""
    if colour_truth_missing() is not None:
        return {}
    made = {setting.name: _make(context_for(context, setting), scene_id) for setting in settings}
    truth = next((converged_colour(*found, CONVERGED_PATHS) for found in made.values() if found is not None), None)
    if truth is None:
        return {}
    answers = {}
    for name, found in made.items():
        if found is not None and (rgb := found[1].pairs[0].input.rgb) is not None:
            answers[name] = {"flip": flip_error(truth, rgb)}
    return answers


def _make(context: WorkerContext, scene_id: int) -> tuple[WorkerContext, Scene] | None:
    try:
        return context, make_scene(context, scene_id, Stopwatch())
    except SceneError:
        return None
