"""A streamed build on many machines: its steps as tasks of a Dask graph.

All workers see the folder of the build and the scan (a network's file system, or one machine). A task's arguments are
the folder's name and a number, never arrays; what it makes are files that appear whole, so that a task that was lost
with its worker is run again by another, and the result has the same bytes.
"""

import functools
import threading
from pathlib import Path

from ..cluster import connect
from ..errors import Error, InputError
from .streamed import Build

_RETRIES = 2  # of a task that fails; workers that end in mid-task are Dask's own matter


def step(folder: str, kind: str, number: int, device: str | None) -> int:
    """Take one step of the build in `folder` on this worker; returns its number."""
    build = _build(folder, device, threading.get_ident())
    if kind == "run":
        build.make_run(build.source(), number)
    elif kind == "check":
        build.check(number)
    else:
        build.build(number)
    return number


@functools.lru_cache(maxsize=4)
def _build(folder: str, device: str | None, thread: int) -> Build:
    """Return the build as this thread of this worker knows it: its runs' index and coarse levels are read once."""
    from ..device import open_device
    return Build(Path(folder), open_device(device))


class OnCluster:
    """The steps of a build as tasks of a client's workers; see `streamed.build_streamed`.

    Parameters
    ----------
    scheduler : str or distributed.Client
    device : str, optional
        The workers' device, by default their own.
    """

    def __init__(self, scheduler, build: Build, device: str | None = None):
        self.build, self.device = build, device
        self.client, self._own = connect(scheduler)

    def close(self) -> None:
        """Leave the scheduler, and end the workers that were started here."""
        for one in self._own:
            one.close()

    def runs(self, numbers, report) -> None:
        """Write the runs that are missing."""
        self._all("run", "read", [n for n in numbers if not self.build.run_written(n)], report)

    def checks(self, numbers, report) -> None:
        """Check the coarse leaves against every cell."""
        self._all("check", "check", [n for n in numbers if not self.build.check_written(n)], report)

    def cells(self, numbers, report) -> None:
        """Build the cells that are missing."""
        self._all("cell", "cells", [n for n in numbers if not self.build.cell_written(n)], report)

    def _all(self, kind: str, stage: str, numbers: list[int], report) -> None:
        from distributed import as_completed
        folder = str(self.build.folder.resolve())
        futures = self.client.map(functools.partial(_named_step, folder, kind, self.device), numbers, pure=False,
                                  retries=_RETRIES, key=[f"clsurf-{kind}-{n}-{id(self)}" for n in numbers])
        try:
            for done, future in enumerate(as_completed(futures)):
                future.result()
                report(stage, (done + 1) / (len(numbers) + (kind == "cell")))
        except Error:
            raise
        except Exception as error:
            if type(error).__module__.startswith("distributed"):
                raise InputError(f"scheduler: a task of the build failed: {error}") from None
            raise
        finally:
            self.client.cancel(futures)


def _named_step(folder: str, kind: str, device: str | None, number: int) -> int:
    return step(folder, kind, number, device)
