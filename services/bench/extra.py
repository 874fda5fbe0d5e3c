"""The extra `study`: the packages that only `verso bench` and `verso tradeoff` need."""

from importlib.util import find_spec

from schemas.errors import MachineError

PACKAGES = {"flip_evaluator": "flip-evaluator", "isal": "isal", "matplotlib": "matplotlib"}
"""Names on the index by the names that are imported."""


def require_extra(command: str) -> None:
    """Raises MachineError, with the remedy, where a package of the extra is not installed."""
    missing = [name for module, name in PACKAGES.items() if find_spec(module) is None]
    if missing:
        raise MachineError(
            f"`verso {command}` needs {', '.join(missing)}: `./verso extra study` installs what is missing in a checkout; "
            "elsewhere use `pip install --require-hashes -r requirements-study.lock`"
        )
