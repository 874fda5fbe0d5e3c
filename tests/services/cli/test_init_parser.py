"""`verso init`, as it is typed."""

from pathlib import Path

from services.cli.parser import build_parser


def test_a_folder_is_enough_and_every_option_is_read():
    plain = build_parser().parse_args(["init", "meshes"])
    assert (plain.folder, plain.out, plain.sheet, plain.category_from, plain.json) == (
        Path("meshes"),
        None,
        None,
        None,
        False,
    )
    words = ["init", "m", "--out", "a.yaml", "--sheet", "a.png", "--category-from", "thing", "--json"]
    full = build_parser().parse_args(words)
    assert (full.out, full.sheet, full.category_from, full.json) == (Path("a.yaml"), Path("a.png"), "thing", True)
