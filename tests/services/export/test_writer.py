import json

import pytest

from services.export.folder import ExportFolder
from services.export.formats import Added, ExportRequest, open_writer
from services.export.source import iter_ranges, scenes_of
from services.export.table import FORMATS
from services.job.record import require_job
from workers.store.commit import list_codes


@pytest.mark.parametrize("name", FORMATS)
def test_a_writer_that_goes_on_from_a_state_is_where_the_first_one_was(name, files, tmp_path):
    request, record = ExportRequest(files, tmp_path, name), require_job(files)
    folder = ExportFolder(tmp_path)
    with folder.claimed({}):
        first = open_writer(name, request, record, folder, None)
        assert first.state() is not None
        stored = next(iter_ranges(files, list_codes(files), 0))
        for scene in scenes_of(files, stored, [0, 1]):
            assert first.add(scene) == Added(pairs=2)
        first.finish()
        state = first.state()
        assert state is not None
        second = open_writer(name, request, record, folder, json.loads(json.dumps(state)))
        assert (second.state(), second.describe()) == (state, first.describe())
