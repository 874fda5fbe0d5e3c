"""The type of the file system that a folder lies on."""

import os
import re
from pathlib import Path


def file_system_of(folder: str | Path) -> str:
    """The type (`ext4`, `nfs4` ...) of the file system that holds `folder`, `unknown` where Linux does not say."""
    try:
        lines = Path("/proc/self/mountinfo").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:
        return "unknown"
    place = os.path.realpath(folder)
    best, kind = "", "unknown"
    for line in lines:
        fields, _, rest = line.partition(" - ")
        mount = re.sub(r"\\(\d{3})", lambda octal: chr(int(octal[1], 8)), fields.split()[4])
        inside = place == mount or place.startswith(mount.rstrip("/") + "/")
        if inside and len(mount) >= len(best):
            best, kind = mount, rest.split()[0]
    return kind
