"""Scenes that shards under way have made and not reported, by what their workers note. Pure."""

from collections.abc import Iterable, Mapping

from schemas.dataset.shard import Span


def count_under_way(shards: Iterable[tuple[Span, ...]], in_progress: Mapping[int, int | None]) -> int:
    """How many scenes of these shards are made: ranges before the last one in progress, and scenes before the one in progress.

    in_progress: the scene that a worker makes now by the start of its range; None between scenes, which counts as none of it. A
    range whose commit is under way is there too, while the next one is made.
    """
    return sum(_made_of(spans, in_progress) for spans in shards)


def _made_of(spans: tuple[Span, ...], in_progress: Mapping[int, int | None]) -> int:
    made = before = 0
    for span in spans:
        if span.start in in_progress:
            scene_id, ids = in_progress[span.start], span.scene_ids
            made = before + (ids.index(scene_id) if scene_id is not None and scene_id in ids else 0)
        before += span.count
    return made
