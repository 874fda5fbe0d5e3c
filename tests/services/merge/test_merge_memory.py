"""Merging takes as much memory for many ranges as for few."""

import hashlib
import json
import subprocess
import sys

import pyarrow as pa
import pyarrow.compute as pc
import pytest

from schemas.dataset.commit import CommitRecord, FileEntry, SceneMark, Span
from schemas.dataset.layout import commit_path, range_table_path
from schemas.dataset.tables import SCHEMAS, TABLES
from tests.made_up_scenes import made_scene, terms
from workers.store.commit import encode_record
from workers.store.local import LocalStore
from workers.store.manifest import encode_table, sorted_rows, table_of_rows

SCENES = 320
"""In a range; 13 rows and 22 files each."""

MERGE = """
import json, resource, sys, time
from services.merge import reading, shared, tables
from services.merge.merge import merge
from workers.store.local import LocalStore
tables.ROWS_PER_GROUP, reading.ROWS_PER_BLOCK, shared.CACHE_KIB = json.loads(sys.argv[5])
warm, root, scenes = LocalStore(sys.argv[1]), LocalStore(sys.argv[2]), int(sys.argv[3])
merge(warm, 0, int(sys.argv[4]))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
begun = time.perf_counter()
result = merge(root, 0, scenes)
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps({"rows": result.rows, "grown_kib": after - before, "peak_kib": after, "seconds": time.perf_counter() - begun}))
"""


def templates() -> dict[str, pa.Table]:
    """The rows of one range."""
    outputs = [made_scene(scene_id, shapes=False) for scene_id in range(SCENES)]
    rows = {table: [row for output in outputs for row in output.rows.get(table, ())] for table in TABLES}
    rows["assets"] = list({row["instance_id"]: row for row in rows["assets"]}.values())
    return {table: sorted_rows(table, table_of_rows(table, rows[table])) for table in TABLES}


def shifted(table: str, rows: pa.Table, number: int) -> pa.Table:
    """The rows of another range: other ids, other paths, other numbers."""
    for name, step in (("scene_id", SCENES), ("pose_id", 2 * SCENES), ("parent_id", 2 * SCENES)):
        if name in rows.column_names:
            at = rows.schema.get_field_index(name)
            rows = rows.set_column(at, rows.schema.field(at), pc.add(rows.column(name), number * step))
    if table == "assets":
        names = pc.binary_join_element_wise(rows.column("instance_id"), str(number), "-")
        rows = rows.set_column(0, rows.schema.field(0), names)
    if table == "views":
        files = rows.column("files").combine_chunks()
        items = files.flatten()
        paths = pc.binary_join_element_wise(items.field("path"), f"{number:05d}", "")
        digests = pa.array([hashlib.sha256(path.encode()).hexdigest() for path in paths.to_pylist()])
        struct = pa.StructArray.from_arrays([paths, items.field("bytes"), digests], fields=list(items.type))
        at = rows.schema.get_field_index("files")
        rows = rows.set_column(at, rows.schema.field(at), pa.ListArray.from_arrays(files.offsets, struct))
    return rows.cast(SCHEMAS[table])


def commit_ranges(root, ranges: int) -> None:
    """So many committed ranges without their images."""
    store = LocalStore(root)
    store.prepare()
    base = templates()
    for number in range(ranges):
        start = number * SCENES
        files, tables = [], {}
        for table in TABLES:
            rows = shifted(table, base[table], number)
            data = encode_table(rows)
            path = range_table_path(start, table)
            (store.root / path).parent.mkdir(parents=True, exist_ok=True)
            (store.root / path).write_bytes(data)
            files.append(FileEntry(path=path, bytes=len(data), sha256=hashlib.sha256(data).hexdigest()))
            tables[table] = rows.num_rows
        record = CommitRecord(
            schema_version=1,
            span=Span(start=start, stop=start + SCENES),
            attempt="r0-made-up",
            terms=terms(range_size=SCENES, layout="tar"),
            files=tuple(files),
            tables=tables,
            scenes=tuple(SceneMark(scene_id=i, outcome="made", digest="") for i in range(start, start + SCENES)),
        )
        (store.root / commit_path(start)).write_bytes(encode_record(record))


def measure(folder, ranges: int, limits: list[int]) -> dict:
    """What merging took, beyond what a small merge in the same process had taken before."""
    commit_ranges(folder / "warm", 2)
    commit_ranges(folder / "many", ranges)
    more = [str(ranges * SCENES), str(2 * SCENES), json.dumps(limits)]
    command = [sys.executable, "-c", MERGE, str(folder / "warm"), str(folder / "many"), *more]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def test_what_a_merge_holds_in_memory_is_what_its_limits_say(tmp_path):
    """Limits of a tenth show it with a tenth of the rows: without them, these rows and files take over 100 MiB."""
    figures = measure(tmp_path, 16, [512, 512, 2 << 10])
    assert sum(figures["rows"].values()) == 16 * (SCENES * 14 + 10)
    assert figures["grown_kib"] / 1024 < 40


@pytest.mark.slow
def test_merging_a_million_rows_takes_little_more_memory_than_few(tmp_path, record_figure):
    figures = measure(tmp_path, 224, [8_192, 2_048, 16 << 10])
    rows = sum(figures["rows"].values())
    assert rows == 224 * (SCENES * 14 + 10)
    record_figure("merge_rows_per_s", "passed", rows / figures["seconds"])
    record_figure("merge_grown_mib", "passed", figures["grown_kib"] / 1024, 192.0)
    assert figures["grown_kib"] / 1024 < 192.0


MANY = """
import json, sys
from pathlib import Path
from services.merge.merge import merge
from tests.kit.many_ranges import ManyRanges

class Watched(ManyRanges):
    rss_mib = {}

    def _tables(self, scene_id):
        if scene_id * 20 % self.scenes == 0:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self.rss_mib[scene_id] = pages * 4096 / 2**20
        return super()._tables(scene_id)

store = Watched(Path(sys.argv[1]), int(sys.argv[2]))
store.prepare()
result = merge(store, 0, store.scenes)
print(json.dumps({"rows": result.rows, "rss_mib": list(store.rss_mib.values())}))
"""


@pytest.mark.slow
def test_merging_many_ranges_takes_as_much_memory_at_the_end_as_at_the_beginning(tmp_path, record_figure):
    """Measured once by hand with 100,000 ranges (docs/scale.md); each range kept 5 kB of memory before."""
    command = [sys.executable, "-c", MANY, str(tmp_path), "20000"]
    figures = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert figures["rows"]["views"] == 10 * (20_000 - 20)
    early, late = figures["rss_mib"][2], figures["rss_mib"][-1]
    record_figure("merge_grown_mib_in_18000_ranges", "passed", late - early, 48.0)
    assert late - early < 48.0
