"""The steps of a streamed build in this process: chunks are read ahead, cells are built two at a time."""

import contextlib
import itertools
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait

from ..device.arrays import give_back
from ..io.chunks import Source
from .stream_runs import make_run

# While one cell's kernels run, the host works at another (autzen, 2 cores: 67 s one at a time with the next one's
# points read ahead and the last one written behind, 52 two at a time, 50 three, with 80 MB more).
AT_ONCE = 2


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
        at_once(missing, build.check, lambda done: report("check", done / len(missing)))

    def cells(self, numbers, report) -> None:
        """Build the cells that are missing."""
        build = self.build
        missing = [number for number in numbers if not build.cell_written(number)]
        at_once(missing, build.build, lambda done: report("cells", done / (len(missing) + 1)))


def at_once(numbers, step, report) -> None:
    """Call step(number) for each, AT_ONCE at a time, and report(how many are done) after each.

    Where one fails or `report` raises, what has begun ends and the rest is left.
    """
    left, done = iter(numbers), 0
    with ThreadPoolExecutor(AT_ONCE) as pool:
        begun = {pool.submit(step, number) for number in itertools.islice(left, AT_ONCE)}
        while begun:
            ended, begun = wait(begun, return_when=FIRST_COMPLETED)
            for future in ended:
                future.result()
                done += 1
                report(done)
            begun |= {pool.submit(step, number) for number in itertools.islice(left, len(ended))}


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

