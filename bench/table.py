"""Plain tables: aligned columns that read the same on a terminal, in a log and in a file."""


def print_table(header, rows) -> None:
    """Print rows of text under `header`; the first column is left-aligned, the others right-aligned."""
    cells = [tuple(map(str, header)), *(tuple(map(str, row)) for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    for n, row in enumerate(cells):
        print("  ".join(text.ljust(w) if i == 0 else text.rjust(w)
                        for i, (text, w) in enumerate(zip(row, widths, strict=True))).rstrip())
        if n == 0:
            print("  ".join("-" * w for w in widths))


def profile_rows(profile) -> list[tuple[str, str, str, str, str]]:
    """Return the rows of a `clsurf.device.Profile` as text: label, calls, minimum and median in ms, share."""
    return [(label, str(calls), f"{low:.3f}", f"{median:.3f}", f"{share:.1%}")
            for label, calls, low, median, share in profile.rows()]
