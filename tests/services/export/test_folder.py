import subprocess
import sys

import pytest

from schemas.errors import CorruptError, InUseError, OutputError
from services.export.folder import ExportFolder


def test_what_was_appended_after_the_last_checkpoint_is_taken_back(tmp_path):
    folder = ExportFolder(tmp_path / "new")
    with folder.claimed({"format": "x"}) as progress:
        assert progress is None
        folder.append("a/list.txt", b"one\n")
        folder.checkpoint({"next_scene": 1})
        folder.append("a/list.txt", b"two\n")
        folder.append("b.txt", b"b")
    part = next((tmp_path / "new" / "_export" / "parts").iterdir())
    part.write_bytes(part.read_bytes() + b"tw")
    again = ExportFolder(tmp_path / "new")
    with again.claimed({"format": "x"}) as progress:
        assert progress is not None and progress["next_scene"] == 1
        assert not (tmp_path / "new" / "a").exists()
        again.append("a/list.txt", b"three\n")
        again.checkpoint({"next_scene": 2})
        again.finish({"pairs": 1})
    assert (tmp_path / "new" / "a" / "list.txt").read_bytes() == b"one\nthree\n"
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["a", "export.json"]
    assert ExportFolder(tmp_path / "new").finished() == {"pairs": 1}


def test_a_part_that_is_shorter_than_it_was_left_is_told(tmp_path):
    folder = ExportFolder(tmp_path / "new")
    with folder.claimed({}):
        folder.append("list.txt", b"one\n")
        folder.checkpoint({})
    (tmp_path / "new" / "_export" / "parts" / "list.txt").write_bytes(b"o")
    with (
        pytest.raises(CorruptError, match="shorter than the export left it"),
        ExportFolder(tmp_path / "new").claimed({}),
    ):
        pass


def test_an_unfinished_export_is_not_mixed_with_another(tmp_path):
    with ExportFolder(tmp_path / "new").claimed({"format": "x", "dataset_digest": None}):
        pass
    with ExportFolder(tmp_path / "new").claimed({"format": "x", "dataset_digest": "abc"}):
        pass
    with (
        pytest.raises(OutputError, match="format: x there, y here"),
        ExportFolder(tmp_path / "new").claimed({"format": "y", "dataset_digest": None}),
    ):
        pass
    (tmp_path / "new" / "_export" / "plan.json").write_text("{")
    with (
        pytest.raises(CorruptError, match="remove the folder"),
        ExportFolder(tmp_path / "new").claimed({"format": "x"}),
    ):
        pass


def test_two_processes_do_not_write_one_export(tmp_path):
    holder = (
        "import sys\nfrom pathlib import Path\nfrom services.export.folder import ExportFolder\n"
        f"with ExportFolder(Path({str(tmp_path / 'new')!r})).claimed({{}}):\n    print('held', flush=True)\n    sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", holder], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"held\n"
        with pytest.raises(InUseError, match="another export writes into"), ExportFolder(tmp_path / "new").claimed({}):
            pass
        process.kill()
    with ExportFolder(tmp_path / "new").claimed({}):
        pass


def test_a_place_that_is_no_folder_or_not_writable_is_refused(tmp_path):
    (tmp_path / "file").touch()
    for target in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="cannot be written"), ExportFolder(target).claimed({}):
            pass
