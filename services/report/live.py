"""The live part of the page: state, progress, failures so far, and the latest pictures. Pure: progress to HTML."""

from collections.abc import Sequence
from html import escape

from schemas.errors import describe_seconds
from services.report.gallery import Address, strip_html
from services.report.progress import Phase, Progress
from services.report.sample import ShownScene
from services.study.words import number

STATES: dict[Phase, str] = {
    "empty": "Waiting for a job",
    "making": "Making scenes",
    "stopped": "Stopped",
    "finished": "Finished",
    "unreadable": "Cannot be read",
}


def live_html(progress: Progress, latest: Sequence[ShownScene], address: Address) -> str:
    """The contents of the live section."""
    return _state(progress) + _troubles(progress) + _latest(progress, latest, address)


def title_of(progress: Progress) -> str:
    """The title of the window: the share that is done, and the job."""
    share = f"{progress.done / progress.asked:.0%} · " if progress.asked and progress.phase == "making" else ""
    return f"{share}{progress.name or 'Verso'}"


def _state(progress: Progress) -> str:
    state = f'<span class="state {progress.phase}">{STATES[progress.phase]}</span>'
    if progress.phase == "empty":
        job = (
            f"The job {progress.name} asks for {progress.asked:,} scenes." if progress.name else "There is no job yet."
        )
        return f'<p class="lead">{state}</p><p class="empty">{escape(job)} This page follows the folder.</p>'
    if progress.phase == "unreadable":
        return f'<p class="lead">{state}</p>'
    facts = [f"{progress.done:,} of {progress.asked:,} scenes"]
    if progress.scenes_per_s is not None:
        facts.append(f"{number(float(f'{progress.scenes_per_s:.2g}'))} a second")
    if progress.left_s:
        facts.append(f"{describe_seconds(progress.left_s)} left")
    facts.append(f"{sum(progress.failed.values()):,} failed")
    if progress.running:
        facts.append(
            f"now at {', '.join(map(str, progress.running[:4]))}{' and more' if len(progress.running) > 4 else ''}"
        )
    bar = f'<progress max="{max(progress.asked, 1)}" value="{progress.done}" aria-label="Scenes done"></progress>'
    return f'<p class="lead">{state} {escape(" · ".join(facts))}</p>{bar}'


def _troubles(progress: Progress) -> str:
    lines = [f"{count:,} failed, {told.replace('_', ' ')}" for told, count in progress.failed.items()]
    items = "".join(f"<li>{escape(line)}</li>" for line in [*progress.told, *lines])
    return f'<ul class="troubles">{items}</ul>' if items else ""


def _latest(progress: Progress, latest: Sequence[ShownScene], address: Address) -> str:
    if not latest or progress.phase == "unreadable":
        return ""
    return f'<div class="latest">{"".join(strip_html(scene, address) for scene in latest)}</div>'
