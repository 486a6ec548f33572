"""The steps of a streamed build one after the other in this process; one thread reads ahead, one writes behind."""

import contextlib
from concurrent.futures import ThreadPoolExecutor

from ..device.arrays import give_back
from ..io.chunks import Source
from .stream_cells import cell_points
from .stream_runs import make_run


class Here:
    """The steps of a `streamed.Build`, from the file's `Source`."""

    def __init__(self, build, source: Source):
        self.build, self.source = build, source

    def close(self) -> None:
        """Do nothing: no workers were started."""

    def runs(self, numbers, report) -> None:
        """Write the runs that are missing."""
        folder, lattice = self.build.work / "runs", self.build.lattice()
        missing = [number for number in numbers if not self.build.run_written(number)]
        for done, (number, chunk) in enumerate(ahead(missing, self.source.read)):
            make_run(folder, number, self.source, lattice, chunk)
            give_back()
            report("read", (done + 1) / len(missing))

    def checks(self, numbers, report) -> None:
        """Check the coarse leaves against every cell."""
        build = self.build
        missing = [number for number in numbers if not build.check_written(number)]
        for done, (number, points) in enumerate(ahead(
                missing, lambda number: cell_points(build.runs, build.plan, number, halo=False))):
            build.check(number, points)
            report("check", (done + 1) / len(missing))

    def cells(self, numbers, report) -> None:
        """Build the cells that are missing."""
        build = self.build
        missing = [number for number in numbers if not build.cell_written(number)]
        with ThreadPoolExecutor(1) as writer:  # 0.11 s of each 1.1 of autzen's cells
            writing = None
            for done, (number, points) in enumerate(ahead(
                    missing, lambda number: cell_points(build.runs, build.plan, number))):
                made = build.cell(points)
                if writing is not None:
                    writing.result()
                writing = writer.submit(build.write, number, *made)
                del made
                give_back()
                report("cells", (done + 1) / (len(missing) + 1))
            if writing is not None:
                writing.result()


def ahead(numbers, read):
    """Yield (number, read(number)), the next one being read meanwhile."""
    with ThreadPoolExecutor(1) as pool:
        waiting = [pool.submit(read, number) for number in numbers[:1]]
        try:
            for place, number in enumerate(numbers):
                result = waiting.pop().result()
                if place + 1 < len(numbers):
                    waiting.append(pool.submit(read, numbers[place + 1]))
                yield number, result
                del result
        finally:
            for future in waiting:
                future.cancel()
                with contextlib.suppress(Exception):
                    future.result()

