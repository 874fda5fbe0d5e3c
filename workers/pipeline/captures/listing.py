"""The sources of a job: the catalogue of its shapes, and the folders of its captures."""

import hashlib
from dataclasses import replace
from pathlib import Path

from schemas.capture.listing import CaptureListing
from schemas.errors import AssetSourceError, CaptureError
from schemas.job.job import Job
from workers.assets.catalogue import Catalogue, open_catalogue
from workers.assets.external.listing import Watch, ignore
from workers.store.capture_inputs import digest_inputs


def open_sources(job: Job, job_folder: Path, watch: Watch = ignore) -> Catalogue:
    """The job's catalogue; with folders of captures its digest covers every input file of theirs.

    `watch` is told now and then how far it is. Raises AssetSourceError where a folder cannot be used.
    """
    catalogue = open_catalogue(job.assets, job_folder, tuple(job.categories), watch)
    if job.captures is None or not job.captures.folders:
        return catalogue
    listings = []
    for number, name in enumerate(job.captures.folders):
        watch("captures", number, len(job.captures.folders))
        listings.append(list_capture((job_folder / Path(name).expanduser()).resolve(), f"captures.folders.{number}"))
    watch("captures", len(listings), len(listings))
    whole = "\n".join([catalogue.digest, *(listing.sha256 for listing in listings)])
    return replace(catalogue, captures=tuple(listings), digest=hashlib.sha256(whole.encode()).hexdigest())


def list_capture(folder: Path, key: str) -> CaptureListing:
    """A folder and the digest of its input files. Raises AssetSourceError that names the key of the job file."""
    if not folder.is_dir():
        raise AssetSourceError(f"{key}: {folder} is no folder")
    try:
        return CaptureListing(folder, digest_inputs(folder))
    except CaptureError as error:
        raise AssetSourceError(f"{key}: {error.detail}") from error
