"""Write docs/api.md, the reference of every public name, from the docstrings: `python docs/api.py`."""

import inspect
import re
import textwrap
from pathlib import Path

import clsurf

GROUPS = (
    ("Scans", ("load", "load_frames", "save", "Mesh", "PointCloud", "RangeImage", "RangeScan", "estimate_normals",
               "models")),
    ("Surfaces", ("build_slim", "build_patches", "build_surfels", "build_scale_map", "morph", "SlimSurface",
                  "PatchSurface", "SurfelHierarchy", "ScaleMap", "Placed", "StoredSurface", "open_surface", "to_mesh",
                  "to_points")),
    ("Pictures", ("render", "Renderer", "Frame", "Camera", "Scene", "Light", "Material", "Shading", "SlimDrawing",
                  "PatchDrawing", "SurfelDrawing", "ScaleMapDrawing", "PointDrawing")),
    ("Moving pictures", ("CameraPath", "turntable", "load_cameras", "save_cameras", "render_frames", "write_video")),
    ("The viewer", ("view", "Viewer")),
    ("Rays and nearest points", ("trace", "Hits", "project", "Projection")),
    ("Measures", ("curvature", "Curvature", "color_map", "line_surface", "line_channels", "lines", "Lines", "error",
                  "SurfaceError", "sparsity", "slim_of_error", "report")),
    ("Clean scans", ("smooth",)),
    ("Devices and errors", ("open_device", "Device", "Profile", "Error", "errors")),
)

HEAD = """# API reference

Every public name of clsurf, from its docstring: `python docs/api.py` writes this page. World units are those of the
scan; a device is what `open_device` takes.
"""


def signature(name: str, thing) -> str:
    """Return how `thing` is called, without addresses and without the types of arguments."""
    try:
        found = inspect.signature(thing)
    except (TypeError, ValueError):
        return name
    plain = [p.replace(annotation=p.empty) for key, p in found.parameters.items() if key not in ("self", "cls")]
    text = str(found.replace(parameters=plain, return_annotation=found.empty))
    text = re.sub(r"<factory>|<function [^>]*>|<[^<>]* object at 0x[0-9a-f]+>", "...", text)
    wrapped = textwrap.wrap(name + text, 100, subsequent_indent="    ", break_long_words=False)
    return "\n".join(wrapped)


def described(thing) -> str:
    """Return the docstring: its prose, and its sections as a block that keeps their layout."""
    text = (inspect.getdoc(thing) or "").rstrip()
    section = re.search(r"^\w+\n-{3,}$", text, re.MULTILINE)
    prose = text[:section.start()].rstrip() if section else text
    return prose + (f"\n\n```text\n{text[section.start():]}\n```" if section else "")


def methods(kind) -> list[tuple[str, object]]:
    """Return the public methods and properties that a class itself defines, in the order of its source."""
    found = []
    for name, value in vars(kind).items():
        value = getattr(value, "__func__", value)
        known = inspect.isfunction(value) or isinstance(value, property) or hasattr(value, "attrname")
        if not name.startswith("_") and known and inspect.getdoc(value):
            found.append((name, value))
    return found


def members(module) -> list[str]:
    """Return a module's public names, defined or imported there."""
    return [name for name, value in vars(module).items()
            if not name.startswith("_") and callable(value) and (getattr(value, "__module__", "") or "").startswith(
                "clsurf")]


def entry(name: str, thing, level: int = 3) -> list[str]:
    """Return the lines of one name."""
    head = f"{'#' * level} `{name}`\n"
    if inspect.ismodule(thing):
        out = [head, described(thing) + "\n"]
        for member in members(thing):
            out += entry(f"{name}.{member}", getattr(thing, member), level + 1)
        return out
    called = [] if inspect.isclass(thing) and issubclass(thing, Exception) else [
        f"```python\n{signature(name, thing)}\n```\n"]
    out = [head, *called, described(thing) + "\n"]
    if inspect.isclass(thing):
        if own := methods(thing):
            out.append("\n".join(summary(method, value) for method, value in own) + "\n")
    return out


def summary(name: str, value) -> str:
    """Return one line of a list: a method with its arguments, or a property, and the first sentence about it."""
    text = inspect.getdoc(value)
    first = " ".join(text.partition("\n\n")[0].split())
    if inspect.isfunction(value):
        name = " ".join(signature(name, value).split())
    return f"- `{name}`: {first}"


def page() -> str:
    """Return api.md.

    Raises
    ------
    ValueError
        A public name without a group, or a group's name that is not public.
    """
    grouped = [name for _, names in GROUPS for name in names]
    odd = set(grouped) ^ set(clsurf.__all__)
    if odd or len(grouped) != len(set(grouped)):
        raise ValueError(f"docs/api.py: expected every public name once in GROUPS, look at {sorted(odd)}")
    parts = [HEAD]
    seen = []
    for title, names in GROUPS:
        anchors = []
        for name in names:  # of headings that differ by case only, the later ones are numbered
            again = seen.count(name.lower())
            seen.append(name.lower())
            anchors.append(f"[{name}](#{name.lower()}{f'-{again}' if again else ''})")
        parts.append(f"- {title}: {', '.join(anchors)}")
    parts.append("")
    for title, names in GROUPS:
        parts.append(f"## {title}\n")
        for name in names:
            parts += entry(name, getattr(clsurf, name))
    return "\n".join(parts).rstrip() + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("api.md").write_text(page(), encoding="utf-8")
