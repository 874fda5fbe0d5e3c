"""Files that many pairs share: one open for each split, all ended together, so that a killed export goes on at an end."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from services.export.folder import ExportFolder


class Shard(Protocol):
    """A file that is being written."""

    bytes: int
    """About how large it is."""

    def close(self) -> None:
        """Ends the file; nothing is added afterwards."""


class Rounds:
    """Opens shards by split; ends a round, which is one shard of each split at most, when the largest is full."""

    def __init__(
        self, folder: ExportFolder, open_shard: Callable[[Path], Any], pattern: str, most_bytes: int, state: dict | None
    ) -> None:
        self._folder, self._open, self._pattern, self._most = folder, open_shard, pattern, most_bytes
        """The pattern has places for `split` and `number`."""
        self._next: dict[str, int] = dict((state or {}).get("next", {}))
        self._shards: dict[str, Any] = {}

    def shard(self, split: str) -> Any:
        """The open shard of a split."""
        if split not in self._shards:
            self._shards[split] = self._open(self._folder.temporary(f"{split}.shard"))
        return self._shards[split]

    def end_if_full(self) -> None:
        """Ends the round where a shard has its size. To be called between scenes."""
        if any(shard.bytes >= self._most for shard in self._shards.values()):
            self.end()

    def end(self) -> None:
        """Gives every open shard its final name."""
        for split in sorted(self._shards):
            self._shards.pop(split).close()
            number = self._next.get(split, 0)
            self._folder.install(
                self._folder.temporary(f"{split}.shard"), self._pattern.format(split=split, number=number)
            )
            self._next[split] = number + 1

    def state(self) -> dict[str, Any] | None:
        """The next number of each split; None within a round."""
        return None if self._shards else {"next": self._next}

    @property
    def counts(self) -> dict[str, int]:
        """Shards by split."""
        return dict(sorted(self._next.items()))

    def close(self) -> None:
        """Closes what is open, unfinished."""
        for shard in self._shards.values():
            shard.close()
