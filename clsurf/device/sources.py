"""Kernel text: found, includes expanded with #line marks, constants prepended.

No -I and no -D reach a driver's compiler: paths with spaces and quoted values break on one driver or the other.
"""

import functools
import re
import zlib
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


ENDED = "clsurf_ended"  # the last of the two arguments that watched kernels have behind their own
WATCH = """
{head}, int clsurf_items, __global int *{ended}) {{
  if ((int)get_global_id(0) < clsurf_items) own_{name}({arguments});
  int turns = 0;
  for (uint i = 0; i < get_work_dim() + 1u; i++) turns++;
  {ended}[turns == (int)get_work_dim() + 1 ? 0 : 1] = {number};
}}
"""


def number_of(kernel: str) -> int:
    """Return the number by which a watched kernel tells which it is."""
    return zlib.crc32(kernel.encode()) & 0x7FFFFFFF


def watched(text: str) -> str:
    """Return kernel text for a driver that ends loops after some turns, all loops of a work-item together.

    Of groups that are not full llvmpipe lets the items that are missing run on in loops until these turns are used up.
    So groups are filled up: only the first `clsurf_items` along x do anything. Each kernel ends with a short loop more;
    where that is cut off, the kernel's own may have been, and it writes its number into ``ended[1]``. Kernels with
    local memory or barriers, whose groups are full, stay as they are.
    """
    text = re.sub(r"//[^\n]*|/\*.*?\*/", lambda match: "\n" * match[0].count("\n"), text, flags=re.S)
    if re.search(r"\b__local\b|\bbarrier\b", text):
        return text
    found = list(SIGNATURE.finditer(text))
    for match in reversed(found):
        text = f"{text[:match.start()]}void own_{match[1]}({match[2]}){text[match.end():]}"
    for match in found:
        arguments = ", ".join(re.findall(r"(\w+)\s*(?:,|$)", match[2].strip()))
        text += WATCH.format(head=match[0][:-1], ended=ENDED, name=match[1], arguments=arguments,
                             number=number_of(match[1]))
    return text


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
