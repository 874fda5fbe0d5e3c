"""Messages that cross Ray (orders and reports of shards, never an image), and the fingerprint of a stack."""

import hashlib
from typing import Literal

from schemas.base import Frozen
from schemas.dataset.commit import CommitSummary, CommitTerms, Span
from schemas.job.job import Job

_SAME_WHEELS = "install the same wheel and requirements.lock, or the same image, on both"
_REMEDIES = {
    "code": _SAME_WHEELS,
    "libraries": _SAME_WHEELS,
    "python": "use the same Python on both, or the same image",
    "binaries": "install the wheels of requirements.lock, none built here (pip --only-binary :all:), or the same image",
    "renderer": "install the same Mesa (libgl1-mesa-dri), or the same GPU and driver, on both",
    "simd": "use processors of one kind, and set NPY_DISABLE_CPU_FEATURES alike (deploy/Dockerfile has the value)",
    "maths": "use machines of one kind with the same C library, or the same image, and unset GLIBC_TUNABLES",
}
"""By field of a fingerprint, the most telling first."""


class Fingerprint(Frozen):
    """A stack; two with the same digest make the same bytes.

    `canary` is the SHA-256 of a small scene, made from plan to encoded files; `code` that of the project's source;
    `libraries` holds the versions of libraries that make bytes; `simd` is the widest instruction set that numpy may use;
    `renderer` is GL's name of itself; `maths` is the SHA-256 of what the C library's and numpy's functions give for many
    numbers, of which the canary scene may meet none that shows a difference; `python` is the interpreter; `binaries` is the
    SHA-256 of how the libraries were built, and of the loaded PyBullet.
    """

    canary: str
    code: str
    libraries: dict[str, str]
    simd: str
    renderer: str
    maths: str = ""
    python: str = ""
    binaries: str = ""

    @property
    def digest(self) -> str:
        """SHA-256, hex, of all fields."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    def remedies(self, other: "Fingerprint") -> str:
        """What makes the two the same, by what differs: a clause without a full stop."""
        differing = (remedy for name, remedy in _REMEDIES.items() if getattr(self, name) != getattr(other, name))
        return next(differing, "their processors or C libraries differ: use machines of one kind, or the same image")

    def differences(self, other: "Fingerprint") -> list[str]:
        """One line for each difference, `name: mine, theirs`."""
        mine, theirs = self.model_dump(), other.model_dump()
        a, b = mine.pop("libraries"), theirs.pop("libraries")
        pairs = [(key, mine[key], theirs[key]) for key in mine]
        pairs += [(name, a.get(name, "absent"), b.get(name, "absent")) for name in sorted({*a, *b})]
        return [f"{name}: {ours}, {other}" for name, ours, other in pairs if ours != other]


Reason = Literal["killed", "time", "memory"]
"""The cause of a worker's death."""


class Blame(Frozen):
    """A scene that killed its worker `max_attempts` times: it is recorded and not tried again."""

    scene_id: int
    reason: Reason
    detail: str
    attempts: int


class JobChange(Frozen):
    """A job.yaml to be written: of an extension just before its first commit, until which what is there holds.

    `before` is empty for a new folder: its first worker writes job.yaml once it has seen that scenes can be framed.
    """

    before: str
    after: str


class ShardOrder(Frozen):
    """Everything that a worker needs to make one shard."""

    out: str
    job: Job
    terms: CommitTerms
    """`terms.fingerprint` is filled in by the worker with its own."""
    spans: tuple[Span, ...]
    blamed: tuple[Blame, ...] = ()
    job_change: JobChange | None = None
    """None where job.yaml is what it will be."""
    label: str = ""
    """Part of the attempts' names: the coordinator recognises its own."""

    @classmethod
    def of(cls, out: str, job: Job, job_digest: str) -> "ShardOrder":
        """The pattern of every order of a job: without ranges and without a fingerprint."""
        terms = CommitTerms(
            job_digest=job_digest,
            fingerprint="",
            fingerprint_mode=job.run.fingerprint,
            layout=job.output.layout,
            first_scene=job.first_scene,
            range_size=job.range_size,
            pairs_per_scene=job.pairs_per_scene,
        )
        return cls(out=out, job=job, terms=terms, spans=())


class SpanReport(Frozen):
    """The result of one range."""

    start: int
    stop: int
    retry: int
    won: bool
    conflict: str | None
    made: int
    failed: dict[str, int]
    """Failures by `kind: reason`."""
    bugs: tuple[str, ...] = ()
    """Scenes that ended in an error nobody expected: the scene, what is in it, and the error, each in one line."""
    commit: CommitSummary | None = None
    """What the valid record says, for the ledger."""


class ShardReport(Frozen):
    """The result of one shard: its ranges in order, and the seconds of each stage."""

    spans: tuple[SpanReport, ...]
    seconds: dict[str, float]
    wall_s: float
    cpu_s: float
    """Processor time of this process."""
    fingerprint: Fingerprint
    host: str
    pid: int
    note: str = ""
    """What a worker has to say about its device, if anything."""
