"""What a run has come to so far."""

import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field

from schemas.dataset.commit import CommitSummary
from schemas.dataset.shard import ShardReport
from services.run.metrics import Counts


@dataclass
class Tally:
    """The results of a run so far; changed by the coordinator alone."""

    asked: int
    made: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    conflicts: list[str] = field(default_factory=list)
    commits: list[CommitSummary] = field(default_factory=list)
    """Those of this run that nobody has taken yet."""
    lost: Counter[str] = field(default_factory=Counter)
    """Workers that died, by cause."""
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Of the workers, by stage."""
    ranges: int = 0
    """Those committed."""
    since: float = field(default_factory=time.time)
    """When the run began to make scenes, seconds since 1970."""
    under_way: int = 0
    """Scenes that workers have made and not reported, as far as their notes tell."""
    in_flight: int = 0
    """Ranges given to Ray and not reported."""
    shard_wall_s: float = 0.0
    shard_cpu_s: float = 0.0

    @property
    def done(self) -> int:
        """Scenes made or failed."""
        return self.made + self.failed.total()

    def add(self, report: ShardReport) -> None:
        """Counts one shard's report."""
        self.shard_wall_s += report.wall_s
        self.shard_cpu_s += report.cpu_s
        for stage, seconds in report.seconds.items():
            self.seconds[stage] += seconds
        for span in report.spans:
            if span.conflict:
                self.conflicts.append(span.conflict)
            self.made += span.made
            self.failed.update(span.failed)
            if span.commit:
                self.add_commit(span.commit)

    def add_commit(self, commit: CommitSummary) -> None:
        """Counts a range that was committed, and keeps it until it is taken."""
        self.commits.append(commit)
        self.ranges += 1

    def take_commits(self) -> list[CommitSummary]:
        """The commits since the last call."""
        commits, self.commits = self.commits, []
        return commits

    def counts(self, slots: int) -> Counts:
        """What a run counts, as it is served: copies, because the run goes on."""
        return Counts(
            asked=self.asked,
            made=self.made,
            failed=dict(self.failed),
            lost=dict(self.lost),
            seconds=dict(self.seconds),
            commits=self.ranges,
            in_flight=self.in_flight,
            slots=slots,
            since=self.since,
            phase="making",
        )
