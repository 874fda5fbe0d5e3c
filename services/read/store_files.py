"""The files of a dataset as a file system of pyarrow's, so that a bucket is scanned as a folder is, a file at a time."""

from typing import Any, NoReturn

import pyarrow as pa
import pyarrow.fs as fs

from schemas.errors import CorruptError
from workers.store.store import Store


def file_system_of(store: Store) -> fs.FileSystem:
    """Reads files by their keys: straight from a disk, from a bucket each as a whole when it is scanned."""
    if store.root is not None:
        return fs.SubTreeFileSystem(str(store.root), fs.LocalFileSystem())
    return fs.PyFileSystem(_StoreFiles(store))


class _StoreFiles(fs.FileSystemHandler):
    """Reads whole objects; nothing can be written, and nothing is listed."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def get_type_name(self) -> str:
        """The kind of file system, for messages."""
        return "verso"

    def normalize_path(self, path: str) -> str:
        """The key itself."""
        return path

    def get_file_info(self, paths: list[str]) -> list[fs.FileInfo]:
        """What is known of files without asking for them: the commits or `_SUCCESS` name them."""
        return [fs.FileInfo(path, fs.FileType.File) for path in paths]

    def open_input_file(self, path: str) -> pa.NativeFile:
        """The object's bytes. Raises CorruptError where it is gone."""
        try:
            return pa.BufferReader(self._store.read(path))
        except FileNotFoundError as error:
            raise CorruptError(f"{path} is committed and missing: restore it from a copy") from error

    def open_input_stream(self, path: str) -> pa.NativeFile:
        """The object's bytes."""
        return self.open_input_file(path)

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise NotImplementedError("a dataset is only read here")

    get_file_info_selector = create_dir = delete_dir = delete_dir_contents = delete_root_dir_contents = _refuse
    delete_file = move = copy_file = open_output_stream = open_append_stream = _refuse
