"""Two JSON files of figures, compared by ratio; what lies beyond the noise is marked."""

from . import record
from .table import print_table

NOISE = 0.05  # medians of the same code on one quiet machine differed by up to 5 %
SKIPPED = ("min_s", "spread", "runs", "share", "cores")  # parts of a timing that are not compared
# Where more is better; everything else measured here (times, errors, faults, bytes) is better when smaller.
MORE_IS_BETTER = ("times_faster", "overlap", "points_per_s", "rays_per_s")


def figures(result: dict, prefix: str = "") -> dict[str, tuple[float, float]]:
    """Return every number of `result` by its dotted name, with its relative noise (0 where it was not timed)."""
    found = {}
    for key, value in result.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            found |= figures(value, name + ".")
        elif isinstance(value, int | float) and not isinstance(value, bool) and key not in SKIPPED:
            found[name] = float(value), float(result.get("spread", 0.0)) if key == "median_s" else 0.0
    return found


def compared(before: dict, after: dict) -> list[dict]:
    """Return one row per figure that both results have.

    Returns
    -------
    list of dict
        ``name``, ``before``, ``after``, ``ratio`` (after over before; nan where before is 0), ``noise`` (relative:
        5 %, or both runs' spreads together where they are larger) and ``verdict``: "better", "worse" or "" within it.
    """
    old, new = figures(before["figures"]), figures(after["figures"])
    rows = []
    for name in (name for name in old if name in new):
        (a, a_noise), (b, b_noise) = old[name], new[name]
        noise = max(NOISE, a_noise + b_noise) if name.endswith("_s") or a_noise else NOISE
        ratio = b / a if a else float("nan") if b else 1.0
        rising = b > a * (1 + noise) if a >= 0 else b > a
        falling = b < a / (1 + noise) if a >= 0 else b < a
        improved = falling
        if any(word in name for word in MORE_IS_BETTER):
            improved = rising
        verdict = "" if not (rising or falling) else "better" if improved else "worse"
        rows.append({"name": name, "before": a, "after": b, "ratio": ratio, "noise": noise, "verdict": verdict})
    return rows


def compare_files(before, after) -> list[dict]:
    """Print and return the comparison of two files; what is in one only is counted."""
    old, new = record.read(before), record.read(after)
    rows = compared(old, new)
    for label, result in (("before", old), ("after", new)):
        made = result["record"]
        print(f"{label:7} {result['job']}: {made['commit']}, {made['device']} ({made['platform']}, {made['driver']}), "
              f"{made['cpu']}, {made['date']}")
    if any(old["record"][key] != new["record"][key] for key in ("cpu", "device", "driver")):
        print("note: not the same machine, device or driver: the ratios compare those too")
    print_table(("figure", "before", "after", "ratio", "noise", ""),
                [(row["name"], f"{row['before']:.6g}", f"{row['after']:.6g}", f"{row['ratio']:.3f}",
                  f"{row['noise']:.0%}", row["verdict"]) for row in rows])
    only = len(figures(old["figures"]).keys() ^ figures(new["figures"]).keys())
    changed = sum(bool(row["verdict"]) for row in rows)
    print(f"{len(rows)} figures compared, {changed} beyond the noise, {only} in one file only")
    return rows
