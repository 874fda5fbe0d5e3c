"""Somebody's text on one line of a message: cut, and without characters that a terminal obeys."""


def plain_line(text: str, most: int = 80) -> str:
    """`text` with at most `most` characters of it, and an escape in place of what is not printable."""
    cut = text if len(text) <= most else f"{text[: most - 3]}..."
    return cut if cut.isprintable() else "".join(map(_printable, cut))


def _printable(character: str) -> str:
    return character if character.isprintable() else character.encode("unicode_escape").decode()
