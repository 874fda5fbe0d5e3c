"""Scenes that shards under way have made and not reported, by what their workers note. Pure."""

from collections.abc import Iterable, Mapping

from schemas.dataset.shard import Span


def count_under_way(shards: Iterable[tuple[Span, ...]], in_progress: Mapping[int, int | None]) -> int:
    """How many scenes of these shards are made: ranges before the one in progress, and scenes before the one in progress.

    in_progress: the scene that a worker makes now by the start of its range; None between scenes, which counts as none of it.
    """
    return sum(_made_of(spans, in_progress) for spans in shards)


def _made_of(spans: tuple[Span, ...], in_progress: Mapping[int, int | None]) -> int:
    before = 0
    for span in spans:
        if span.start in in_progress:
            scene_id = in_progress[span.start]
            ids = span.scene_ids
            return before + (ids.index(scene_id) if scene_id is not None and scene_id in ids else 0)
        before += span.count
    return 0
