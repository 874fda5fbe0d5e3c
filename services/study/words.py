"""Amounts, times and sizes in words, for the sentence, the plots and the page. Pure."""

from services.study.model import ERRORS

_SIZES = ((1e3, 1.0, "kB"), (1e6, 1e3, "MB"), (1e9, 1e6, "GB"), (float("inf"), 1e9, "TB"))


def short(name: str) -> str:
    """An error's name in a few words."""
    return ERRORS[name].short if name in ERRORS else name.replace("_", " ")


def unit(name: str) -> str:
    """The unit that an error is shown in: "mm", "deg", "%" for shares, or nothing."""
    return "%" if name.endswith("_share") else ERRORS[name].unit if name in ERRORS else ""


def shown(name: str, value: float) -> float:
    """An error in the unit that it is shown in."""
    return value * 100.0 if name.endswith("_share") else value


def amount(name: str, value: float) -> str:
    """An error with its unit, three digits: "0.1 mm", "0.25 %"."""
    return f"{number(shown(name, value))} {unit(name)}".strip()


def number(value: float) -> str:
    """Three digits: "0", "0.00012", "13.4", "1,250"; below a ten-thousandth and from a million on "3.5e-5"."""
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        digits, _, exponent = f"{value:.3g}".partition("e")
        return f"{digits}e{int(exponent)}" if exponent else digits
    return f"{float(f'{value:.3g}'):,.8f}".rstrip("0").rstrip(".")


def as_often(ratio: float) -> str:
    """A ratio of times in two digits: "1" within the noise of 5 %, "0.62", "1.6", "47"."""
    return "1" if abs(ratio - 1.0) < 0.05 else number(float(f"{ratio:.2g}"))


def cost(ratio: float) -> str:
    """A ratio of times as a cost: "2 × the time", or "no more time" within the noise."""
    often = as_often(ratio)
    return "no more time" if often == "1" else f"{often} × the time"


def times(ratio: float) -> str:
    """A ratio of times with its word, and a third digit near 1: "1.07 times"."""
    return f"{number(round(ratio, 2)) if 0.9 <= ratio < 1.1 else as_often(ratio)} times"


def milliseconds(ms: float) -> str:
    """The time of a scene: "118 ms", "11.2 s"."""
    return f"{number(ms)} ms" if ms < 9999.5 else f"{number(ms / 1e3)} s"


def size(kilobytes: float) -> str:
    """The size of a job's files: "15 MB"."""
    return next(f"{number(_two(kilobytes / one))} {name}" for most, one, name in _SIZES if kilobytes < most)


def _two(value: float) -> float:
    return float(f"{value:.2g}") if value < 100.0 else float(round(value))


def listed(words: list[str]) -> str:
    """Words in one phrase: "a", "a and b" or "a, b and c"."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
