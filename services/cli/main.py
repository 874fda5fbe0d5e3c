"""The command line: runs the handler of one command and turns errors into exit codes."""

import importlib
import json
import sys

from schemas.errors import VersoError
from services.cli.environment import enter_stack_environment
from services.cli.parser import build_parser


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns 0 if complete, 1 if something is missing or wrong, 2 for wrong input."""
    if argv is None:
        enter_stack_environment()
        argv = sys.argv[1:]
    if argv[:1] == ["test"]:
        from services.cli.selftest import main as run_tests

        return run_tests(argv[1:])
    options = build_parser().parse_args(argv)
    try:
        module, _, function = options.handler.partition(":")
        return int(getattr(importlib.import_module(module), function)(options) or 0)
    except VersoError as error:
        print(f"verso: {error}", file=sys.stderr)
        if getattr(options, "json", False):
            print(json.dumps({"ok": False, "error": str(error), "kind": type(error).__name__}))
        return error.exit_code
    except KeyboardInterrupt:
        print("verso: interrupted; what is committed is kept, the same command goes on from there", file=sys.stderr)
        return 1
    except BrokenPipeError:
        return 1


if __name__ == "__main__":
    sys.exit(main())
