"""Rise of the peak resident memory in the second build of a scan; run as a script, in a process of its own.

    python memory.py SCAN.pickle DEGREE ERROR DEVICE    prints one line of JSON

The first build brings what is paid once (drivers, programs); after it everything kept for reuse is given back and the
kernel's peak (VmHWM) is reset, so that the rise is what one more build needs beyond its input.
"""

import gc
import json
import pickle
import sys
from pathlib import Path


def resident(field: str) -> int:
    """Return ``VmRSS`` or ``VmHWM`` of this process in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return 1024 * int(line.split()[1])
    raise OSError(f"no {field} in /proc/self/status")


def main(path: str, degree: str, error: str, selector: str) -> None:
    """Build twice; print the rise of the peak in the second build, and the size of what it made."""
    from clsurf.build.slim import build_slim
    from clsurf.device import open_device
    device = open_device(selector)
    scan = pickle.loads(Path(path).read_bytes())

    def build():
        return build_slim(scan, degree=int(degree), error=float(error), device=device)

    build()
    gc.collect()
    device.trim()
    before = resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    surface = build()
    print(json.dumps({"rise_bytes": resident("VmHWM") - before, "surface_bytes": surface.nbytes,
                      "points": len(scan.points)}))


if __name__ == "__main__":
    main(*sys.argv[1:])
