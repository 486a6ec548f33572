"""Ctrl-C while the command line still imports: one line in place of a traceback, as `clsurf.cli.main` has it later."""

import sys
from pathlib import Path


def say_stopped(kind, value, trace) -> None:
    """Print what ended the program, as `sys.excepthook`; Python itself then ends it with the signal."""
    if issubclass(kind, KeyboardInterrupt):
        print("clsurf: stopped", file=sys.stderr)
    else:
        sys.__excepthook__(kind, value, trace)


# Only where this process is the command: a program of someone else's keeps its own hook.
if sys.orig_argv[1:3] == ["-m", "clsurf"] or Path(sys.argv[0] if sys.argv else "").stem == "clsurf":
    sys.excepthook = say_stopped
