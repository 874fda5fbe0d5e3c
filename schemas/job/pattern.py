"""Patterns of file names, as `Path.glob` reads them, for paths that are already known."""

from fnmatch import fnmatchcase


def matches(path: str, pattern: str) -> bool:
    """Whether `Path.glob(pattern)` finds the file of this path, both relative with `/` between; `**`: any folders, or none."""
    *folders, file = path.split("/")
    *wanted, name = [part for part in pattern.split("/") if part not in ("", ".")] or ["**"]
    if name == "**" or not fnmatchcase(file, name):  # `**` alone finds folders
        return False
    reached = {0}
    for part in wanted:
        if part == "**":
            reached = {place for start in reached for place in range(start, len(folders) + 1)}
        else:
            reached = {place + 1 for place in reached if place < len(folders) and fnmatchcase(folders[place], part)}
    return len(folders) in reached
