"""The sources of shapes of a stored job, as far as they are still what they were."""

from pathlib import Path

from schemas.errors import VersoError
from services.job.record import JobRecord
from workers.assets.catalogue import Catalogue
from workers.pipeline.captures.listing import open_sources


def unchanged_sources(record: JobRecord) -> Catalogue | None:
    """The catalogue of a job; None where its folders are not here, or hold something else than when the job was run."""
    try:
        catalogue = open_sources(record.job, Path(record.folder))
    except (VersoError, OSError):
        return None
    return catalogue if catalogue.digest == record.catalogue else None
