from pathlib import Path

from services.export.folder import ExportFolder, Rounds


class Lines:
    def __init__(self, path: Path) -> None:
        self.file = path.open("wb")
        self.bytes = 0

    def add(self, data: bytes) -> None:
        self.file.write(data)
        self.bytes += len(data)

    def close(self) -> None:
        self.file.close()


def test_a_round_ends_for_every_split_when_one_shard_is_full(tmp_path):
    folder = ExportFolder(tmp_path / "new")
    with folder.claimed({}):
        rounds = Rounds(folder, Lines, "{split}-{number:02d}.txt", 4, None)
        assert rounds.state() == {"next": {}}
        rounds.shard("train").add(b"abc")
        rounds.end_if_full()
        assert rounds.state() is None
        rounds.shard("test").add(b"x")
        rounds.shard("train").add(b"d")
        rounds.end_if_full()
        assert rounds.state() == {"next": {"test": 1, "train": 1}}
        again = Rounds(folder, Lines, "{split}-{number:02d}.txt", 4, rounds.state())
        again.shard("train").add(b"e")
        again.end()
        assert again.counts == {"test": 1, "train": 2}
    files = {path.name: path.read_bytes() for path in (tmp_path / "new").glob("*.txt")}
    assert files == {"train-00.txt": b"abcd", "test-00.txt": b"x", "train-01.txt": b"e"}


def test_a_shard_that_is_not_ended_has_no_final_name(tmp_path):
    folder = ExportFolder(tmp_path / "new")
    with folder.claimed({}):
        rounds = Rounds(folder, Lines, "{split}-{number:02d}.txt", 4, None)
        rounds.shard("train").add(b"abc")
        rounds.close()
    assert not list((tmp_path / "new").glob("*.txt"))
