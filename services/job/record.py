"""OUT/job.yaml: the job that an output folder belongs to. Another job is refused, naming the keys. And OUT/_SUCCESS."""

import json
import unicodedata
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from schemas.dataset.layout import JOB_FILE, LOCK_FILE, LOG_FOLDER, MANIFEST, STAGING, SUCCESS_FILE, is_merged_path
from schemas.errors import CorruptError, JobError, OutputError, did_you_mean
from schemas.job.job import Job, compare_jobs, job_digest
from services.job.job_file import parse_yaml, paths_of, validate_job
from workers.store.commit import is_sealed, seal
from workers.store.store import Store

OWN = {MANIFEST, STAGING, LOCK_FILE, LOG_FOLDER}
"""What a run makes before it writes the job file: a folder with only these is no foreign one."""

NOBODYS = {"lost+found"}
"""What a new file system holds at its top."""

HEADER = """\
# The job as it was run, every default filled in. Written by the first run on this folder; `verso run` on the same
# folder goes on where it stopped, and refuses a job that differs in anything but `scenes` (more of them) and `run`.
# `digest` covers what the dataset is: all other keys that differ from their defaults, and the files of the asset folders
# (`catalogue`). `folder` is where the job file lay: relative asset folders start there. `seal` is the SHA-256 of all bytes
# above it.
"""

SEAL = "seal: "
"""Begins the last line of job.yaml."""

REMEDY = "restore it from a copy"


@dataclass(frozen=True)
class JobRecord:
    """A job, the digest of its asset catalogue, and the folder that its relative paths start from.

    `inputs`: digest of the input files of each folder of captures, which `catalogue` covers too; none without such folders.
    """

    job: Job
    digest: str
    catalogue: str
    folder: str
    inputs: tuple[str, ...] = ()

    def describe_change(self, inputs: tuple[str, ...]) -> str:
        """The files of the job's sources that are others now, in words; `inputs` are the digests of the folders now."""
        names = self.job.captures.folders if self.job.captures is not None else []
        changed = [name for name, before, now in zip(names, self.inputs, inputs, strict=False) if before != now]
        if changed:
            return f"the files of the captures in {', '.join(changed[:5])}{' and more' if len(changed) > 5 else ''}"
        if len(self.inputs) != len(inputs):
            return f"captures.folders, which were {len(self.inputs)} and are {len(inputs)}"
        named = [key for key, path in paths_of(self.job).items() if path]
        return " or ".join([*(f"the files that {key} names" for key in named), "the built-in shapes of this version"])


def record_job(
    job: Job, catalogue_digest: str, folder: Path, inputs: tuple[str, ...] = (), out: Store | None = None
) -> JobRecord:
    """The record of a job with the digest of its asset catalogue; `folder` is the job file's, `out` the output folder.

    The size of ranges is written down also where it follows from the job: a dataset that is extended keeps it. Raises
    OutputError where `out` belongs to another job, naming the keys.
    """
    old = read_job(out) if out is not None else None
    if out is not None and old is not None:
        differing = [f"  {key}: {before} there, {after} here" for key, before, after in compare_jobs(old.job, job)]
        if old.catalogue != catalogue_digest and not differing:
            differing.append(f"  {old.describe_change(inputs)} (their digest changed)")
        if differing:
            lines = [f"{out.name} belongs to another job; these differ:", *differing]
            raise OutputError("\n".join([*lines, "choose another --out, or change them back"]))
    range_size = old.job.range_size if old is not None else job.range_size
    job = job.model_copy(update={"run": job.run.model_copy(update={"range_size": range_size})})
    return JobRecord(job, job_digest(job, catalogue_digest), catalogue_digest, str(folder.resolve()), inputs)


def encode_job(record: JobRecord) -> bytes:
    """OUT/job.yaml; without the preset, which has filled its keys, and would fill those that a later version adds to it."""
    job = record.job.model_dump(mode="json", exclude={"preset"})
    tree: dict[str, Any] = {"digest": record.digest, "catalogue": record.catalogue, "folder": record.folder}
    tree |= {"inputs": list(record.inputs)} if record.inputs else {}
    tree["job"] = job
    return seal(HEADER + yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=110), SEAL)


def read_job(store: Store) -> JobRecord | None:
    """The job that a folder belongs to, None where it has none. Raises CorruptError with one line."""
    name = f"{store.name}/{JOB_FILE}"
    try:
        return decode_job(store.read(JOB_FILE), name)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CorruptError(f"{name} cannot be read: {error.strerror or error}; {REMEDY}") from error


def decode_job(data: bytes, name: str) -> JobRecord:
    """The job in the bytes of a job.yaml, whatever its seal says. Raises CorruptError naming the file, with one line."""
    try:
        tree = parse_yaml(data.decode())
        job, inputs = validate_job(tree["job"], name), tuple(tree.get("inputs", ()))
        texts = {key: tree[key] for key in ("digest", "catalogue", "folder")}
        for key, value in (*texts.items(), *(("inputs", digest) for digest in inputs)):
            if not isinstance(value, str):
                raise TypeError(f"{key} is no text")
        folder = texts["folder"]
        if not folder.startswith("/") or any(unicodedata.category(letter) == "Cc" for letter in folder):
            raise TypeError(f"folder: {folder!r} is not an absolute path")
        return JobRecord(job, **texts, inputs=inputs)
    except (JobError, ValueError, TypeError, KeyError, AttributeError) as error:
        problem = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        if isinstance(error, JobError):
            problem = str(error).splitlines()[0].removeprefix(f"{name}: ")
        raise CorruptError(f"{name} is not a job that `verso run` wrote: {problem}; {REMEDY}") from error


def is_job_sealed(data: bytes) -> bool:
    """Whether the bytes of a job.yaml are those that a run wrote."""
    return is_sealed(data, SEAL)


def require_folder(place: str | Path) -> None:
    """Raises OutputError where a folder of this machine is not there; a bucket is not asked."""
    path = Path(place)
    if "://" in str(place) or path.is_dir():
        return
    if path.exists():
        raise OutputError(f"{place} is a file, and should be a folder")
    beside = [entry.name for entry in path.parent.iterdir()] if path.parent.is_dir() else []
    near = did_you_mean(path.name, beside).strip()
    raise OutputError(f"{place}: there is no such folder{near and f'; {near}'}")


def require_dataset(store: Store) -> Store:
    """The store itself. Raises OutputError where it holds no dataset."""
    if store.root is not None:
        require_folder(store.root)
    if store.size(JOB_FILE) is None:
        begun = store.size(LOCK_FILE) is not None
        why = "a run is just beginning there, ask again" if begun else "it is not an output folder of `verso run`"
        raise OutputError(f"{store.name} holds no {JOB_FILE}: {why}")
    return store


def require_job(store: Store) -> JobRecord:
    """The job that a folder belongs to. Raises OutputError where it is no dataset."""
    record = read_job(require_dataset(store))
    assert record is not None
    return record


def refuse_foreign(store: Store) -> None:
    """Raises OutputError where a folder holds files and no job: a dataset is not mixed with other files."""
    if store.size(JOB_FILE) is None and (foreign := sorted(set(store.names("")) - OWN - NOBODYS)):
        raise OutputError(
            f"{store.name} holds {', '.join(foreign[:3])}{' and more' if len(foreign) > 3 else ''}, and no {JOB_FILE}: "
            "choose an empty or a new folder for --out"
        )


def read_success(store: Store) -> dict | None:
    """The contents of `_SUCCESS`, None where there is none or it is not whole."""
    try:
        success = json.loads(store.read(SUCCESS_FILE))
    except (FileNotFoundError, ValueError):
        return None
    return success if _is_whole(success) else None


def _is_whole(success: object) -> bool:
    """Whether the keys that readers of `_SUCCESS` use are of their types, and its files those that a merge writes."""
    kinds = {"schema_version": int, "digest": str, "files": dict, "scenes": dict, "rows": dict}
    if not isinstance(success, dict) or any(not isinstance(success.get(key), kind) for key, kind in kinds.items()):
        return False
    files = success["files"].items()
    named = all(is_merged_path(path) and isinstance(file, dict) and "bytes" in file for path, file in files)
    return named and "environmental" in success["scenes"]
