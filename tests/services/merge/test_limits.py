"""Limits of a machine that a merge must live with: a disk that is full at any point, and memory however many ranges.

Real disks that are full are in tests/chaos.
"""

import json
import resource
import subprocess
import sys

import pytest

from schemas.dataset.layout import STAGING
from schemas.errors import MachineError
from services.merge.merge import merge
from tests.made_up_datasets import FIRST, STOP, dataset_at

pytestmark = pytest.mark.usefixtures("unflushed")


def test_a_merge_without_room_at_any_size_of_a_file_says_so_and_can_be_done_again(merged, tmp_path):
    """Writes beyond so many bytes of a file fail, as on a full disk."""
    store = dataset_at(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    limits = [64]
    while True:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limits[-1], before[1]))
        try:
            merge(store, FIRST, STOP)
            break
        except MachineError as error:
            message = str(error)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert "could not write" in message or "could not be written" in message
        assert "\n" not in message and not list(store.files(STAGING))
        limits.append(limits[-1] * 8 // 5)
    assert len(limits) > 12
    assert merge(store, FIRST, STOP) == merged[1]


MANY = """
import json, sys, time
from pathlib import Path
from services.merge import merge, reading, tables
from tests.kit.many_ranges import ManyRanges

folder, ranges, limits = Path(sys.argv[1]), int(sys.argv[2]), json.loads(sys.argv[3])
tables.ROWS_PER_GROUP, merge.ROWS_PER_BLOCK, reading.CACHE_KIB = limits

class Watched(ManyRanges):
    rss_mib = {}

    def _tables(self, scene_id):
        if scene_id * 20 % self.scenes == 0:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self.rss_mib[scene_id] = pages * 4096 / 2**20
        return super()._tables(scene_id)

store = Watched(folder, ranges)
begun = time.perf_counter()
result = merge.merge(store, 0, store.scenes)
print(json.dumps([result.rows, list(store.rss_mib.values()), time.perf_counter() - begun]))
"""


@pytest.mark.parametrize(
    ("ranges", "limits", "most_mib"),
    [
        pytest.param(2_000, [512, 512, 2 << 10], 16.0, marks=pytest.mark.minute),
        pytest.param(20_000, [8_192, 4_096, 16 << 10], 48.0, marks=pytest.mark.slow),
    ],
)
def test_a_merge_takes_as_much_memory_at_its_end_as_at_its_beginning(ranges, limits, most_mib, tmp_path, record_figure):
    """Limits of a tenth show with a tenth of the rows what those of the program hold."""
    command = [sys.executable, "-c", MANY, str(tmp_path), str(ranges), json.dumps(limits)]
    rows, rss_mib, seconds = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert rows["views"] == 10 * (ranges - ranges // 1000)
    grown = rss_mib[-1] - rss_mib[2]
    record_figure(f"merge_grown_mib_in_{ranges}_ranges", "passed", grown, most_mib)
    record_figure("merge_rows_per_s", "passed", sum(rows.values()) / seconds)
    assert grown < most_mib
