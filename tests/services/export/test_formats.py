"""Every format has a writer, and each writer a part of its own."""

from services.export.folder import ExportFolder
from services.export.formats import FORMATS, ExportRequest, open_writer
from services.job.record import require_job


def test_every_format_opens_a_writer_of_its_own(files, tmp_path):
    folder, record = ExportFolder(tmp_path), require_job(files)
    with folder.claimed({}):
        writers = [open_writer(name, ExportRequest(files, tmp_path, name), record, folder, None) for name in FORMATS]
    assert len({type(writer) for writer in writers}) == len(FORMATS)
