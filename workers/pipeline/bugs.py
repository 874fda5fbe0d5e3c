"""What is told of a scene in which something was raised that is no refusal: a bug, or memory that ran out."""

import contextlib
import traceback
from pathlib import PurePath

from schemas.dataset.layout import LOG_FOLDER
from schemas.errors import SceneError
from workers.pipeline.context import WorkerContext
from workers.plan.randomness import SceneChance
from workers.plan.step import choose_assets
from workers.store.store import Store


class UnexpectedError(SceneError):
    """A scene that stopped at an error nobody expected. The others go on, and `--retry-failed` makes it again."""

    stage = "worker"
    kind = "environmental"


def explain(error: Exception) -> UnexpectedError:
    """The row of a scene that ended in this error."""
    if isinstance(error, MemoryError):
        told = "a worker had too little memory for this scene: use fewer workers, then run with --retry-failed"
        return UnexpectedError("memory", f"{told} ({describe(error)})")
    return UnexpectedError("bug", f"{describe(error)}: report this, then run with --retry-failed")


def describe(error: BaseException) -> str:
    """One line: the kind of error, its first line, and where in the code it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" at {PurePath(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    said = next(iter(str(error).splitlines()), "")[:200]
    return f"{type(error).__name__}{f': {said}' if said else ''}{where}"


def name_scene(context: WorkerContext, scene_id: int) -> str:
    """The scene with its category and the instances in it, as far as they can be drawn, or the capture and its folder."""
    drawn = ""
    if context.job.captures is not None:
        folders = context.job.captures.folders
        return f"capture {scene_id}{f' ({folders[scene_id]})' if scene_id < len(folders) else ''}"
    with contextlib.suppress(Exception):  # what failed may be the draw itself
        objects, table = choose_assets(context.job, context.catalogue, SceneChance(context.job.seed, scene_id))
        each = ", ".join(f"{ref.category} {ref.instance_id}" for ref in objects)
        drawn = f" ({each}, on table {table.instance_id})"
    return f"scene {scene_id}{drawn}"


def keep_traceback(store: Store, scene_id: int, error: BaseException) -> str:
    """Writes the traceback beside the logs; where it is, for the end of a sentence."""
    key = f"{LOG_FOLDER}/scene-{scene_id}.txt"
    try:
        store.put(key, "".join(traceback.format_exception(error)).encode(), durable=False)
    except Exception:  # a log must not end the scene's range
        return ""
    return f"; the traceback is in {store.name}/{key}"
