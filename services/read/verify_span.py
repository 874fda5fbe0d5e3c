"""The scenes that a dataset must hold, against those that are committed: gaps, overlaps, and commits that cannot be read."""

from collections.abc import Iterator
from itertools import groupby
from operator import itemgetter

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import COMMITS, commit_path, parse_commit_name
from services.read.verdict import COPY, MOST_FAULTS, Verdict
from workers.store.store import Store


def commit_groups(store: Store) -> Iterator[tuple[int, list[int]]]:
    """(start, retries) of every range that has a commit record, in order. Other files are left to the search for strays."""
    files = (entry.key.removeprefix(f"{COMMITS}/") for entry in store.files(COMMITS, sizes=False))
    names = sorted(name for file in files if (name := parse_commit_name(file)) is not None)
    for start, group in groupby(names, key=itemgetter(0)):
        yield start, [retry for _, retry in group]


class Spans:
    """Takes ranges in order; knows the scenes that no range holds, and those whose commit or tables cannot be read."""

    def __init__(self, asked: tuple[int, int] | None, range_size: int, finished: bool, verdict: Verdict) -> None:
        self.asked = asked
        """First scene and stop; None where neither job.yaml nor `_SUCCESS` says it."""
        self.gaps: list[tuple[int, int]] = []
        self.unreadable: list[tuple[int, int]] = []
        """Scenes [start, stop) of a damaged range; stop is a guess where its record cannot be read."""
        self.done = 0
        """Committed scenes."""
        self.foreign = False
        """Whether scenes are committed twice, or outside of those asked."""
        self._range_size = range_size
        self._finished = finished
        self._verdict = verdict
        self._awaited = None if asked is None else asked[0]
        self._torn: int | None = None
        """Start of the damaged range just before, whose stop is not known."""

    @property
    def whole(self) -> bool:
        """Whether every scene asked is committed once, by ranges that can be read."""
        return not (self.gaps or self.unreadable or self.foreign) and bool(self.done)

    @property
    def fits(self) -> bool:
        """Whether the ranges taken so far can be merged."""
        return not (self.gaps or self.unreadable or self.foreign or self._torn is not None)

    def take(self, start: int, records: tuple[CommitRecord, ...]) -> None:
        """The next range, with its retries; without records where they cannot be read."""
        self._reach(start)
        if not records:
            self._torn = start
            return
        stop = records[0].span.stop
        self.done += stop - start
        if self.asked is not None and not self.asked[0] <= start < stop <= self.asked[1]:
            self.foreign = True
            told = f"{commit_path(start)}: scenes {start} to {stop - 1} are committed, outside of those asked"
            self._verdict.tell(told, f"{self.asked[0]} to {self.asked[1] - 1} are, by job.yaml or _SUCCESS; {COPY}")
        self._awaited = stop

    def spoil(self, start: int, stop: int) -> None:
        """Marks a range whose tables cannot be read."""
        self.unreadable.append((start, stop))

    def finish(self) -> None:
        """After the last range."""
        self._reach(self.asked[1] if self.asked else None)

    def _reach(self, start: int | None) -> None:
        """Goes on to the range at `start`, or to the end."""
        if self._torn is not None:
            guess = self._torn + self._range_size
            self.unreadable.append((self._torn, min(guess, start) if start is not None else guess))
            self._awaited = self.unreadable[-1][1]
            self._torn = None
        if start is None or self._awaited is None:
            return
        if start > self._awaited:
            self._tell_gap(self._awaited, start)
        elif start < self._awaited and (self.asked is None or start != self.asked[1]):
            self.foreign = True
            self._verdict.tell(f"{commit_path(start)}: scene {start} is committed twice", COPY)

    def _tell_gap(self, start: int, stop: int) -> None:
        """Names each missing commit of a finished dataset, the scenes of an unfinished one."""
        self.gaps.append((start, stop))
        first = self.asked[0] if self.asked else start
        size, run = self._range_size, self._verdict.run_again
        line = first + ((start - first) // size + 1) * size
        starts = [start, *range(line, stop, size)] if (stop - start) // size < MOST_FAULTS else [start]
        if not self._finished or len(starts) == 1:
            told = f"{commit_path(start)}: " if self._finished else ""
            self._verdict.tell(f"{told}scenes {start} to {stop - 1} are not committed", f"{run} to make them")
            return
        for begin, end in zip(starts, [*starts[1:], stop], strict=True):
            told = f"{commit_path(begin)}: is missing: scenes {begin} to {end - 1} are not committed"
            self._verdict.tell(told, f"{run} to make them")
