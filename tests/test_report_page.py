"""The report's page: what it holds, and how a browser lays it out."""

import html
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from test_report import bumps

import clsurf
from clsurf.io.images import read_image
from clsurf.report import charts, sections
from clsurf.report.page import heat, page
from clsurf.report.statistics import patch_statistics

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
# Put into a copy of the page by the test: what a reader would see go wrong, as text in the title.
LAYOUT = """<script>
addEventListener("load", () => {
  const wrong = [];
  if (document.documentElement.scrollWidth > innerWidth) wrong.push("the page is wider than its window");
  for (const image of document.images) if (!image.naturalWidth) wrong.push("a picture is not shown");
  for (const svg of document.querySelectorAll("svg")) {
    const box = svg.viewBox.baseVal, texts = [...svg.querySelectorAll("text")];
    const boxes = texts.map(text => text.getBBox());
    boxes.forEach((a, i) => {
      if (a.x < -1 || a.y < -1 || a.x + a.width > box.width + 1 || a.y + a.height > box.height + 1)
        wrong.push("cut: " + texts[i].textContent);
      for (let k = 0; k < i; k++) {
        const b = boxes[k];
        if (a.x < b.x + b.width && b.x < a.x + a.width && a.y + 3 < b.y + b.height && b.y + 3 < a.y + a.height)
          wrong.push("overlap: " + texts[i].textContent + " / " + texts[k].textContent);
      }
    });
  }
  document.title = "layout: " + (wrong.join("; ") || "good") + " in " + innerWidth;
});
</script>"""


@pytest.fixture(scope="module")
def reports(tmp_path_factory, device):
    """A report of patches and of a SLIM surface under a name with markup in it, and of all in one scene."""
    folder = tmp_path_factory.mktemp("reports")
    patches, slim = bumps(count=40), clsurf.build_slim(clsurf.models.sphere(2000), device=device)
    matrix = np.eye(4)
    matrix[:3, 3] = patches.bounds.mean(axis=0)
    scene = clsurf.Scene([patches, slim.moved(matrix)])
    clsurf.report(patches, folder / "patches.html", None, (240, 180), '<b>"bumps" & more</b>.clsurf', device=device)
    clsurf.report(slim, folder / "slim.html", size=(200, 200), device=device)
    clsurf.report(scene, folder / "scene.html", size=(200, 150), device=device)
    return SimpleNamespace(folder=folder, patches=patches, slim=slim)


def browser():
    """Return a headless browser's path; without one, checks of every change fail, elsewhere the test is skipped."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)("needs a browser: apt-get install chromium")
    return found


def opened(path, folder, width, height=2600):
    """Return the document and the picture (h, w, 4) that a browser makes of a page."""
    shot = folder / f"{path.stem}-{width}.png"
    command = [browser(), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
               "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
               f"--user-data-dir={folder / 'profile'}", f"--window-size={width},{height}", f"--screenshot={shot}",
               "--dump-dom", path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout, np.asarray(read_image(shot))


class _Balanced(HTMLParser):
    """Collects tags that are closed in the wrong order, and the references of all others."""

    EMPTY = ("meta", "img", "link", "br")

    def __init__(self):
        super().__init__()
        self.open, self.wrong, self.references, self.words = [], [], [], []

    def handle_starttag(self, tag, attributes):
        self.references += [value for name, value in attributes if name in ("src", "href", "xlink:href", "srcset")]
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)

    def handle_data(self, data):
        self.words.append(data)


@pytest.mark.parametrize("name", ["patches", "slim", "scene"])
def test_the_page_is_whole_and_fetches_nothing(name, reports):
    text = (reports.folder / f"{name}.html").read_text(encoding="utf-8")
    parsed = _Balanced()
    parsed.feed(text)
    assert not parsed.wrong and not parsed.open
    assert all(r.startswith("data:image/png;base64,") for r in parsed.references) and len(parsed.references) == 2
    assert not re.search(r"https?:|@import|url\(|<script|<link|<iframe", text)
    assert os.listdir(reports.folder).count(f"{name}.html") == 1
    assert not [n for n in os.listdir(reports.folder) if n.startswith(".")]  # nothing half-written


def test_the_page_tells_the_statistics(reports):
    text = (reports.folder / "patches.html").read_text(encoding="utf-8")
    s = patch_statistics(reports.patches, clsurf.Camera.framing(reports.patches, aspect=240 / 180), (240, 180))
    small = patch_statistics(reports.patches, clsurf.Camera.framing(reports.patches, aspect=240 / 180), (150, 112))
    assert f"<td>{s.interpolated_nodes:,}</td><td>{small.interpolated_nodes:,}</td>" in text
    assert f"<td>{s.operations['triangles'].total:,.0f}</td>" in text
    assert f"<td>{s.normals.shares['ordered']:.1%}</td>" in text
    assert "&lt;b&gt;&quot;bumps&quot; &amp; more" in text and "<b>" not in text
    assert "project_patches" in text and "tile_patches" in text  # stages
    slim = (reports.folder / "slim.html").read_text(encoding="utf-8")
    assert f"<td>{int(reports.slim.leaf.sum()):,}</td>" in slim and "tile_slim" in slim
    scene = (reports.folder / "scene.html").read_text(encoding="utf-8")
    assert "0: Operations by mode" in scene and "1: Surfels" not in scene and "1: View" in scene


@pytest.mark.parametrize(("name", "width"), [("patches", 1100), ("scene", 500), ("slim", 800)])
def test_a_browser_shows_it(name, width, reports, tmp_path):
    """No text cut or over another, nothing wider than the window, the pictures in their places."""
    path = tmp_path / f"{name}.html"
    text = (reports.folder / path.name).read_text(encoding="utf-8")
    path.write_text(text.replace("</head>", LAYOUT + "</head>"), encoding="utf-8")
    document, shot = opened(path, tmp_path, width)
    title = html.unescape(re.search(r"<title>(.*?)</title>", document)[1])
    assert title == f"layout: good in {width}"
    assert document.count("<svg") >= 3 and "Time by stage" in document
    assert shot.shape[1] == width and len(np.unique(shot[..., :3].reshape(-1, 3), axis=0)) > 200


def test_a_name_that_breaks_nothing():
    rows = sections.table(("<u>",), [("<s>", "&")])
    text = page("</title><script>alert(1)</script>", [sections.Section("<i>", rows)])
    assert "<script>" not in text and "<i>" not in text and "<u>" not in text and "<s>" not in text and "&amp;" in text


def test_charts():
    drawn = charts.stacked([("one", [1, 3], "4"), ("none", [0, 0], "0")], ["a", "b"], "title")
    widths = [float(w) for w in re.findall(r'class="c\d" x="[\d.]+" y="(?!6")[\d.]+" width="([\d.]+)"', drawn)]
    assert widths[1] == 3 * widths[0] and widths[2:] == [0, 0]
    assert charts.bars([], "empty").count("<rect") == 0 and "nan" not in charts.bars([("zero", 0, "0")], "zero")
    assert "<title>" in charts.columns(["a" * 3], [5], "c") and charts.columns([], [], "c")
    assert [charts.short_number(v) for v in (0, 842, 12345, 1.08e6, 2e9)] == ["0", "842", "12.3K", "1.08M", "2G"]


def test_heat():
    values, shown = np.array([[0.0, 5.0, 10.0]]), np.array([[True, True, False]])
    out = heat(values, shown)
    assert out[0, :, 3].tolist() == [255, 255, 0] and out[0, 0, :3].sum() < out[0, 1, :3].sum()
    assert heat(values, np.zeros_like(shown))[..., 3].max() == 0


@pytest.mark.parametrize(("arguments", "says"), [
    (("x.txt",), "html"), (("no/such/x.html",), "folder"), (("x.html", None, (0, 5)), "size"),
    (("x.html", "camera"), "camera")])
def test_wrong_arguments(arguments, says, reports, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(clsurf.errors.InputError, match=says):
        clsurf.report(reports.slim, *arguments)
    assert not os.listdir(tmp_path)


def test_nothing_to_see(tmp_path, device):
    """An empty scene, a surface of no patches and one behind the eye still make a page."""
    empty = clsurf.PatchSurface(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), (17, 17),
                                np.zeros(0, np.int8))
    surface = bumps()
    away = clsurf.Camera.look_at(surface.bounds[1] + 10, surface.bounds[1] + 20)
    for thing, camera in ((clsurf.Scene([]), None), (empty, None), (surface, away)):
        clsurf.report(thing, tmp_path / "r.html", camera, (40, 30), device=device)
        text = (tmp_path / "r.html").read_text(encoding="utf-8")
        assert "</html>" in text and not re.search(r">-?nan|nan%|nan ms", text)
