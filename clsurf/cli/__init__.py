"""The command line: `clsurf demo | devices | doctor | info | build | convert | render | view | trace | report |
smooth | curvature | morph | bench`.

Bad input ends with one line and exit code 2, never with a traceback; long work shows a bar on a terminal and a plain
line per step elsewhere.
"""

import os
import sys
from typing import Annotated

import typer

from ..errors import Error
from .curvature import curvature
from .files import build, convert, info
from .machine import bench, devices, doctor
from .morph import morph
from .pictures import demo, render, report
from .smooth import smooth
from .trace import trace
from .view import view

app = typer.Typer(name="clsurf", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  help="Compact surface models from scans, drawn on any OpenCL device.",
                  context_settings={"help_option_names": ["-h", "--help"]})
for command in (demo, devices, doctor, info, build, convert, render, view, trace, report, smooth, curvature, morph,
                bench):
    app.command()(command)


def print_version(wanted: bool):
    """Print the version and leave, where it is asked for."""
    if wanted:
        from .. import __version__
        print(f"clsurf {__version__}")
        raise typer.Exit


@app.callback()
def options(version: Annotated[bool, typer.Option("--version", callback=print_version, is_eager=True,
                                                  help="Print the version.")] = False):
    """Compact surface models from scans, drawn on any OpenCL device."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code: 0, 1 (the doctor found a lack), 2 (bad input), 130 (Ctrl-C)."""
    import logging

    from rich.logging import RichHandler
    if sys.stderr is None:  # closed by the caller: nothing can be said to it
        sys.stderr = open(os.devnull, "w")
    quiet = any(a in ("-q", "--quiet") for a in (sys.argv[1:] if arguments is None else arguments))
    handler = RichHandler(show_time=False, show_path=False, show_level=False) if sys.stderr.isatty() \
        else logging.StreamHandler()
    logger = logging.getLogger("clsurf")
    logger.addHandler(handler)
    before = logger.level  # put back: a program that calls this keeps its own
    logger.setLevel(logging.ERROR if quiet else logging.INFO)
    try:
        # The option parser turns Ctrl-C and an exit asked for into a code that it returns.
        code = app(arguments, standalone_mode=False) or 0
        if code == 130:
            print("clsurf: stopped", file=sys.stderr)
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except Error as error:
        print(f"clsurf: {error}", file=sys.stderr)
        return 2
    except (typer.Abort, KeyboardInterrupt):
        print("clsurf: stopped", file=sys.stderr)
        return 130
    except typer.Exit as leave:
        return leave.exit_code
    except (BrokenPipeError, SystemExit):
        # The reader of our output has gone (the option parser turns that into an exit); nothing more can be said to it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except MemoryError:
        print("clsurf: not enough memory: use a smaller scan or picture", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"clsurf: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
        return 2
    except Exception as error:
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):  # a usage error of the option parser
            if error.format_message():  # empty where the help was printed instead
                print(f"clsurf: {error.format_message()} (clsurf --help)", file=sys.stderr)
            return 2
        raise
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


if __name__ == "__main__":
    sys.exit(main())
