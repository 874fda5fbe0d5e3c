"""The command line: runs the handler of one command and turns errors into exit codes."""

import argparse
import importlib
import json
import sys
from functools import partial

from schemas.errors import VersoError
from services.cli.environment import enter_stack_environment
from services.cli.parser import build_parser
from services.cli.rows import KEPT
from services.run.supervisor import supervise


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns 0 if complete, 1 if something is missing or wrong, 2 for wrong input.

    From the shell (`argv` is None), a command that starts Ray runs under a supervisor.
    """
    from_shell = argv is None
    if argv is None:
        enter_stack_environment()
        argv = sys.argv[1:]
    options = build_parser().parse_args(argv)
    if from_shell and options.starts_ray(options):
        return supervise(partial(_run, options), options.kept, quiet=options.quiet, answers=options.json)
    try:
        return _run(options)
    except KeyboardInterrupt:
        print(f"verso: interrupted; {KEPT}", file=sys.stderr)
        return 1


def _run(options: argparse.Namespace) -> int:
    """The exit code of a command; errors are told in one line. KeyboardInterrupt passes."""
    try:
        module, _, function = options.handler.partition(":")
        return int(getattr(importlib.import_module(module), function)(options) or 0)
    except VersoError as error:
        print(f"verso: {error}", file=sys.stderr)
        if getattr(options, "json", False):
            print(json.dumps({"ok": False, "error": str(error), "kind": type(error).__name__}))
        return error.exit_code
    except BrokenPipeError:
        return 1
    except OSError as error:
        from workers.store.file_system import remedy_of

        if (remedy := remedy_of(error)) is None:
            raise
        print(f"verso: {error.filename or 'a file'}: {remedy}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
