"""Kernel text: found, includes expanded with #line marks, constants prepended.

No -I and no -D reach a driver's compiler: paths with spaces and quoted values break on one driver or the other.
"""

import functools
import re
from pathlib import Path

import numpy as np
import pyopencl.cltypes as cltypes

from ..errors import DeviceError

INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]+"([^"]+)"[ \t]*$', re.M)
ATTRIBUTES = r"(?:__attribute__\s*\(\(.*?\)\)\s+)*"
SIGNATURE = re.compile(rf"__kernel\s+{ATTRIBUTES}void\s+{ATTRIBUTES}(\w+)\s*\(([^)]*)\)", re.S)
SCALARS = {"char": np.int8, "uchar": np.uint8, "short": np.int16, "ushort": np.uint16, "int": np.int32,
           "uint": np.uint32, "long": np.int64, "ulong": np.uint64, "float": np.float32, "double": np.float64}
SCALARS |= {f"{name}{n}": getattr(cltypes, f"{name}{n}") for name in ("int", "uint", "float") for n in (2, 4, 8, 16)}


@functools.cache
def kernel_folder() -> Path:
    """Return the folder of kernel sources: inside an installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "kernels", package.parent / "kernels"):
        if (folder / "common").is_dir():
            return folder
    raise DeviceError(f"kernel sources: expected a folder 'kernels' in or beside {package}, found none: reinstall "
                      "clsurf")


def expanded(path: str) -> str:
    """Return the text of `path` (relative to the kernels' folder) with every include in place, each file once.

    Includes are relative to the kernels' folder: ``#include "common/lanes.clh"``.
    """
    return _expand(path, seen=set())


def _expand(path: str, seen: set) -> str:
    seen.add(path)
    try:
        text = (kernel_folder() / path).read_text()
    except OSError as error:
        raise DeviceError(f"kernel source {path}: {error}") from None
    parts, at = [f'#line 1 "{path}"\n'], 0
    for match in INCLUDE.finditer(text):
        parts.append(text[at:match.start()])
        if match[1] not in seen:
            parts.append(_expand(match[1], seen))
        line = text.count("\n", 0, match.end()) + 2
        parts.append(f'\n#line {line} "{path}"')
        at = match.end()
    parts.append(text[at:])
    return "".join(parts)


def kernel_text(path: str, constants: dict | None = None) -> str:
    """Return the whole text of a kernel file: ``#define`` lines of `constants`, then the expanded source."""
    lines = []
    for name, value in sorted((constants or {}).items()):
        if isinstance(value, bool | np.bool_):
            value = int(value)
        elif isinstance(value, float | np.floating):
            value = f"{float(value)!r}f" if np.isfinite(value) else "INFINITY"
        lines.append(f"#define {name} {value}\n")
    return "".join(lines) + expanded(path)


def argument_dtypes(text: str, kernel: str) -> list:
    """Return, for each argument of `kernel`, the dtype of a scalar or None for a buffer."""
    text = re.sub(r"//[^\n]*|/\*.*?\*/", "", text, flags=re.S)
    for match in SIGNATURE.finditer(text):
        if match[1] != kernel:
            continue
        dtypes = []
        for argument in filter(None, (a.strip() for a in match[2].split(","))):
            words = [w for w in argument.split() if w not in ("const", "__private", "private")]
            if "*" in argument or "image" in words[0] or words[0] == "sampler_t":
                dtypes.append(None)
            elif words[0] in SCALARS:
                dtypes.append(SCALARS[words[0]])
            else:
                raise DeviceError(f"kernel {kernel}: argument '{argument}' has a type that clsurf does not pass")
        return dtypes
    raise DeviceError(f"kernel {kernel}: not found in its source")
