"""`clsurf build --memory`: scans larger than memory, in one process or on many."""

from pathlib import Path

from .common import Steps, checked_out
from .recipe import Recipe

STAGES = {"read": "read", "plan": "plan", "check": "check coarse levels", "cells": "cells"}


def checked_stream(memory: str, out: Path) -> Path:
    """Return `out`, or raise InputError where a streamed build cannot have the memory or the place."""
    from ..sizes import parse_bytes
    parse_bytes(memory or None)
    if out.suffix.lower() != ".clsurf" or not out.is_dir():
        checked_out(out, (".clsurf",))
    return out


def stream(scan: Path, out: Path, how: Recipe, memory: str, scheduler: str, device, steps: Steps) -> None:
    """Build the surface of `scan` part by part; Ctrl-C leaves what is done, and says so."""
    import clsurf
    try:
        with steps.step("build"):
            build, options = (clsurf.build_patches, how.patches) if how.kind == "patches" else \
                (clsurf.build_slim, how.slim)
            surface = build(scan, **options, memory_limit=memory or None, out=out, device=device,
                            scheduler=scheduler or None,
                            progress=lambda stage, done: steps.progress(STAGES.get(stage, stage), done))
    except KeyboardInterrupt:
        part = out.with_name(out.name + ".part")
        if part.exists():
            steps.say(f"stopped: {part} keeps what is done; the same command goes on with it")
        raise
    steps.say(f"  {surface}")
    steps.say(f"surface: {out.resolve()}")
