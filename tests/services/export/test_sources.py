"""Sources of shapes are used only where they are what they were."""

import dataclasses

from schemas.job.job import Job
from services.export.source import unchanged_sources
from services.job.record import require_job


def test_the_sources_of_a_job_are_its_own(files):
    record = require_job(files)
    found = unchanged_sources(record)
    assert found is not None and found.digest == record.catalogue


def test_sources_that_changed_or_are_gone_are_none(files, tmp_path):
    record = require_job(files)
    assert unchanged_sources(dataclasses.replace(record, catalogue="0" * 64)) is None
    folder = {"source": "urdf", "folder": "gone", "category_map": {"*.obj": "mug"}}
    job = Job.model_validate({"name": "t", "assets": {"objects": [folder]}})
    assert unchanged_sources(dataclasses.replace(record, job=job, folder=str(tmp_path))) is None
