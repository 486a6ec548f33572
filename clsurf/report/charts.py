"""Charts as inline SVG: bars, stacked bars, columns. Colours are classes of clsurf.report.style."""

from html import escape

WIDTH = 640  # of every chart, in its own units; the page scales it
LABEL, VALUE = 170, 96  # width of the label column on the left and of the numbers on the right
ROW = 26
SERIES = 5  # colours that the page's style has, classes c0...c4


def bars(rows: list[tuple[str, float, str]], title: str) -> str:
    """Return horizontal bars.

    Parameters
    ----------
    rows : list of (label, value, text)
        The text stands behind the bar.
    title : str
        Read aloud in place of the picture.
    """
    return stacked([(label, [value], text) for label, value, text in rows], [], title)


def stacked(rows: list[tuple[str, list[float], str]], parts: list[str], title: str) -> str:
    """Return horizontal bars made of several parts, with a legend where the parts have names."""
    room = WIDTH - LABEL - VALUE
    most = max((sum(values) for _, values, _ in rows), default=0) or 1.0
    top = ROW if parts else 0
    out = [_legend(parts)] if parts else []
    for i, (label, values, text) in enumerate(rows):
        y, x = top + i * ROW, float(LABEL)
        out.append(f'<text class="label" x="{LABEL - 8}" y="{y + 17}" text-anchor="end">{escape(_short(label, 24))}'
                   f'<title>{escape(label)}</title></text>')
        for number, value in enumerate(values):
            width = room * value / most
            tip = f"{parts[number]}: {value:,.0f}" if parts else text
            out.append(f'<rect class="c{number % SERIES}" x="{x:.1f}" y="{y + 4}" width="{width:.1f}" '
                       f'height="{ROW - 8}"><title>{escape(tip)}</title></rect>')
            x += width
        out.append(f'<text class="value" x="{x + 6:.1f}" y="{y + 17}">{escape(text)}</text>')
    return _svg(out, top + len(rows) * ROW, title)


def columns(labels: list[str], values: list[float], title: str, below: str = "") -> str:
    """Return vertical columns with a number over and a label under each; `below` names the labels."""
    height, foot, head = 180, 22 + (20 if below else 0), 20
    most = max(values, default=0) or 1.0
    step = min(WIDTH / max(len(values), 1), 90)
    out = []
    for i, (label, value) in enumerate(zip(labels, values, strict=True)):
        tall, middle = (height - head) * value / most, i * step + step / 2
        out.append(f'<rect class="c0" x="{i * step + step * 0.12:.1f}" y="{height - tall:.1f}" '
                   f'width="{step * 0.76:.1f}" height="{tall:.1f}"><title>{escape(f"{label}: {value:,.0f}")}</title>'
                   f'</rect><text class="value" x="{middle:.1f}" y="{height - tall - 5:.1f}" text-anchor="middle">'
                   f'{escape(short_number(value))}</text><text class="label" x="{middle:.1f}" y="{height + 17}" '
                   f'text-anchor="middle">{escape(label)}</text>')
    if below:
        out.append(f'<text class="label" x="0" y="{height + 37}">{escape(below)}</text>')
    return _svg(out, height + foot, title)


def short_number(value: float) -> str:
    """Return a number in at most five characters or so: 842, 12.3K, 1.08M."""
    for limit, letter in ((1e9, "G"), (1e6, "M"), (1e3, "K")):
        if abs(value) >= limit:
            return f"{value / limit:.3g}{letter}"
    return f"{value:.3g}"


def _legend(parts: list[str]) -> str:
    x, out = float(LABEL), []
    for i, name in enumerate(parts):
        out.append(f'<rect class="c{i % SERIES}" x="{x:.0f}" y="6" width="12" height="12"/>'
                   f'<text class="label" x="{x + 17:.0f}" y="17">{escape(name)}</text>')
        x += 17 + 7.2 * len(name) + 18
    return "".join(out)


def _svg(parts: list[str], height: float, title: str) -> str:
    return (f'<svg role="img" viewBox="0 0 {WIDTH} {height:.0f}" aria-label="{escape(title)}">' + "".join(parts)
            + "</svg>")


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else text[:most - 1] + "…"
