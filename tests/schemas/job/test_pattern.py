"""Patterns of file names, held to pathlib's own glob."""

import pytest

from schemas.job.assets import matches

FILES = ("a.obj", "b.OBJ", "x/a.obj", "x/y/a.obj", "x/y/z/b.obj", "x[1]/a b.obj", ".h/a.obj", "x/ü.glb", "xy/a.obj")
PATTERNS = (
    *("*.obj", "**/*.obj", "x/*.obj", "x/**/*.obj", "*/*.obj", "**/y/**/*.obj", "x*/*", "**/*", "**", "x/**", "?.obj"),
    *(
        "[ab].obj",
        "[!a].*",
        "x[[]1]/*",
        "x[1]/*",
        "./a.obj",
        "x//a.obj",
        "**/**/a.obj",
        "*",
        "x/?.glb",
        "X/a.obj",
        "a*.obj",
    ),
)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_pattern_matches_what_glob_finds(tmp_path, pattern):
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found = {path.relative_to(tmp_path).as_posix() for path in tmp_path.glob(pattern) if path.is_file()}
    assert {name for name in FILES if matches(name, pattern)} == found


def test_many_stars_take_no_time():
    assert not matches("a/" * 200 + "b", "**/a/" * 100 + "*/c")
