"""What a dataset says of itself, against its commits: job.yaml and the fingerprint of its stack."""

from dataclasses import dataclass, field

from pydantic import ValidationError

from schemas.dataset.commit import CommitRecord
from schemas.dataset.fingerprint import Fingerprint
from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE, README_FILE, commit_path
from schemas.errors import CorruptError
from schemas.job.identity import job_digest
from services.job.record import JobRecord, decode_job, is_job_sealed
from services.read.verdict import COPY, Verdict, describe_os_error
from workers.store.store import Store

MOST_TOLD = 100
"""Different jobs or stacks that are remembered with a commit of theirs."""


@dataclass(frozen=True)
class StoredJob:
    """A job.yaml as it was found: its record, None where it cannot be read, and whether its bytes are as they were written."""

    record: JobRecord | None = None
    sealed: bool = False
    whole: bool = False
    """As an earlier version wrote it, or sealed."""

    @property
    def digest(self) -> str | None:
        """The job digest of the keys as they are now."""
        return job_digest(self.record.job, self.record.catalogue) if self.record else None


def read_stored_job(store: Store, verdict: Verdict) -> StoredJob:
    """job.yaml, and what is wrong with it by itself."""
    try:
        data = store.read(JOB_FILE)
        record = decode_job(data, JOB_FILE)
    except OSError as error:
        verdict.tell(f"{JOB_FILE}: {describe_os_error(error)}", COPY, "job")
        return StoredJob()
    except CorruptError as error:
        told = str(error).removeprefix(JOB_FILE).lstrip(": ").removesuffix(COPY).rstrip(";: ")
        verdict.tell(f"{JOB_FILE}: {told}", COPY, "job")
        return StoredJob()
    found = StoredJob(record, is_job_sealed(data), is_job_sealed(data))
    if not found.whole:
        verdict.tell(f"{JOB_FILE}: was altered after a run wrote it: its seal does not match", verdict.repair, "job")
    elif record.digest != found.digest:
        verdict.tell(f"{JOB_FILE}: its digest is not that of its keys", verdict.repair, "job")
    return found


@dataclass
class Terms:
    """The jobs and stacks that commits were made with, each with the first commit that names it."""

    jobs: dict[str, str] = field(default_factory=dict)
    range_sizes: dict[int, str] = field(default_factory=dict)
    stacks: dict[tuple[str, str], str] = field(default_factory=dict)
    """By (fingerprint, mode)."""

    def take(self, record: CommitRecord) -> None:
        """Remembers what a commit says."""
        key, terms = commit_path(record.span.start, record.span.retry), record.terms
        if len(self.jobs) < MOST_TOLD:
            self.jobs.setdefault(terms.job_digest, key)
        if len(self.range_sizes) < MOST_TOLD:
            self.range_sizes.setdefault(terms.range_size, key)
        if len(self.stacks) < MOST_TOLD:
            self.stacks.setdefault((terms.fingerprint, terms.fingerprint_mode), key)


def check_terms(job: StoredJob, terms: Terms, verdict: Verdict) -> None:
    """Compares job.yaml with the job digest that every commit holds."""
    if job.record is None or not terms.jobs:
        return
    if job.digest not in terms.jobs:
        digest, key = next(iter(terms.jobs.items()))
        told = f"{JOB_FILE}: its keys or asset files (digest {str(job.digest)[:12]}) are not those of {key} ({digest[:12]})"
        verdict.tell(told, f"{COPY}, or change them back", "job")
    else:
        for digest, key in terms.jobs.items():
            if digest != job.digest:
                verdict.tell(f"{key}: is a commit of another job ({digest[:12]}) than {JOB_FILE}", COPY)
    size = job.record.job.range_size
    if size not in terms.range_sizes and terms.range_sizes:
        told = f"{JOB_FILE}: run.range_size is {size}, that of the commits {next(iter(terms.range_sizes))}"
        verdict.tell(told, f"{COPY}, or change it back", "job")


def check_fingerprint(store: Store, terms: Terms, verdict: Verdict) -> None:
    """Compares the stored fingerprint with those of the commits, to the byte."""
    try:
        data = store.read(FINGERPRINT_FILE)
        stored = Fingerprint.model_validate_json(data)
    except OSError as error:
        verdict.tell(f"{FINGERPRINT_FILE}: {describe_os_error(error)}", verdict.repair, "job")
        return
    except (ValidationError, ValueError):
        verdict.tell(f"{FINGERPRINT_FILE}: is damaged: it is no fingerprint", verdict.repair, "job")
        return
    if not terms.stacks:
        return
    if data != encode_fingerprint(stored):
        verdict.tell(f"{FINGERPRINT_FILE}: was altered after a worker wrote it", verdict.repair, "job")
    elif stored.digest not in {stack for stack, _ in terms.stacks} and not _is_in_card(store, stored):
        told = f"{FINGERPRINT_FILE}: is the fingerprint {stored.digest[:12]}, which no commit has"
        verdict.tell(told, verdict.repair, "job")
    else:
        for (stack, mode), key in terms.stacks.items():
            if mode == "strict" and stack != stored.digest:
                told = f"{key}: has the fingerprint {stack[:12]}, the dataset's is {stored.digest[:12]}"
                verdict.tell(told, "two stacks made one dataset although run.fingerprint was strict; make it anew")


def encode_fingerprint(fingerprint: Fingerprint) -> bytes:
    """The bytes of manifest/_fingerprint.json, as the first worker writes it."""
    return fingerprint.model_dump_json(indent=1).encode()


def _is_in_card(store: Store, stored: Fingerprint) -> bool:
    """Whether DATASET.md names a stack: under `run.fingerprint: record` the first worker may have committed nothing."""
    try:
        return stored.digest.encode() in store.read(README_FILE)
    except OSError:
        return False
