"""A duration in words, the same in every message, table and page."""

_SPANS = ((60.0, 1.0, "s"), (5400.0, 60.0, "min"), (48 * 3600.0, 3600.0, "h"), (float("inf"), 86400.0, "d"))
"""(below so many seconds, seconds in one, its symbol)."""


def describe_seconds(seconds: float) -> str:
    """Seconds in one unit, with two digits or whole: "0.12 s", "8 s", "2.5 min", "31 h", "9 d"."""
    _, one, name = next(span for span in _SPANS if seconds < span[0])
    value = seconds / one
    return f"{float(f'{value:.2g}') if value < 100.0 else round(value):g} {name}"
