"""A merge in progress: takes committed ranges in order, and writes the merged files into a folder."""

from collections import Counter
from itertools import chain
from pathlib import Path

from schemas.dataset.layout import is_shape
from schemas.dataset.tables import DETERMINISTIC_TABLES, SCHEMA_VERSION, TABLES
from services.merge.install import file_entry
from services.merge.poses import PoseFiles
from services.merge.reading import Block
from services.merge.shared import SharedRows
from services.merge.tables import MergedTable
from workers.store.canonical import dataset_digest


class Merging:
    """Takes every range in turn; keeps files below `folder`, which must be empty."""

    def __init__(self, folder: Path) -> None:
        self._tables = {table: MergedTable(table, folder) for table in TABLES}
        self._poses = PoseFiles(folder)
        self._shared = SharedRows(folder)
        self._fingerprints: set[str] = set()
        self._scenes = Counter({"made": 0, "intrinsic": 0, "environmental": 0})

    def add(self, block: Block) -> None:
        """Takes the next ranges. Raises CorruptError where rows do not join."""
        self._fingerprints.update(record.terms.fingerprint for record in chain.from_iterable(block.ranges))
        self._shared.add_files((entry.path, entry.sha256) for _, entry in block.files if is_shape(entry.path))
        rows = block.rows
        self._shared.add_assets(rows["assets"])
        self._shared.add_images(rows["views"])
        self._poses.add(rows["views"], rows["objects"])
        for table in TABLES:
            if table != "assets":
                self._tables[table].add(rows[table])
        self._scenes.update(made=rows["scenes"].num_rows, **Counter(rows["failures"].column("kind").to_pylist()))

    def close(self) -> None:
        """Closes what is open, finished or not."""
        self._shared.close()

    def finish(self) -> tuple[dict, dict[str, Path]]:
        """The contents of `_SUCCESS`, and the finished files by key."""
        mixed = len(self._fingerprints) > 1
        for rows in self._shared.assets(mixed):
            self._tables["assets"].add(rows)
        categories = sorted(self._tables["scenes"].categories | self._tables["failures"].categories)
        files = self._poses.paths
        for table in self._tables.values():
            files = files | table.finish(categories)
        entries = {path: file_entry(local) for path, local in sorted(files.items())}
        self._shared.add_files((path, str(entries[path]["sha256"])) for path in self._poses.paths)
        digests = {table: merged.digest.hexdigest() for table, merged in self._tables.items()}
        success = {
            "schema_version": SCHEMA_VERSION,
            "digest": dataset_digest(digests, self._shared.files(mixed)),
            "tables": {table: digests[table] for table in DETERMINISTIC_TABLES},
            "files": entries,
            "rows": {table: merged.digest.rows for table, merged in self._tables.items()},
            "scenes": dict(self._scenes),
            "images": self._shared.images,
            "fingerprints": sorted(self._fingerprints),
        }
        return success, files
