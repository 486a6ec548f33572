"""The documentation: the reference is current, links lead somewhere, marked code runs, the gallery's pictures show."""

import importlib.util
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

import clsurf

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")
MARKED = re.compile(r"<!-- run -->\n```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
RUN = [page for page in PAGES if MARKED.search(page.read_text(encoding="utf-8"))]


@pytest.fixture
def chosen(monkeypatch):
    """PoCL, for code that names no device: pages and pictures use nearly every kernel; each has its tests elsewhere.

    Intel's runtime compiles them for more than four minutes.
    """
    monkeypatch.setenv("CLSURF_DEVICE", "pocl")


def module(name: str):
    """Return docs/NAME.py as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives the headings of a page."""
    found = []
    for line in FENCE.sub("", page.read_text(encoding="utf-8")).splitlines():
        if line.startswith("#"):
            name = re.sub(r"[^\w\- ]", "", line.lstrip("#").strip().lower()).replace(" ", "-")
            found.append(f"{name}-{found.count(name)}" if name in found else name)
    return set(found)


def test_the_reference_is_current_and_whole():
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    assert module("api").page() == text, "docs/api.md is not current: run python docs/api.py"
    for name in clsurf.__all__:
        assert f"\n### `{name}`\n" in text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in LINK.findall(FENCE.sub("", page.read_text(encoding="utf-8"))):
        if "://" in target:
            continue
        file, _, anchor = target.partition("#")
        place = page.parent / file if file else page
        assert place.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(place), f"{page.name}: {target}"


def test_every_page_is_in_the_index():
    listed = LINK.findall((DOCS / "README.md").read_text(encoding="utf-8"))
    assert {page.name for page in DOCS.glob("*.md")} - {"README.md"} <= set(listed)


@pytest.mark.parametrize("page", RUN, ids=lambda page: page.name)
def test_marked_code_runs(page, chosen, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    names = {}
    for code in MARKED.findall(page.read_text(encoding="utf-8")):
        exec(compile(code, page.name, "exec"), names)  # the blocks of a page go on from one another
    assert names["clsurf"] is clsurf  # it ran, and on this package


def test_the_gallery_shows_something(chosen, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["gallery.py", "--quick", str(tmp_path)])
    gallery = runpy.run_path(str(DOCS / "gallery.py"), run_name="__main__")
    for picture in gallery["PICTURES"]:
        pixels = oiio.ImageBuf(str(tmp_path / f"{picture.__name__}.png")).get_pixels(oiio.UINT8)[..., :3].astype(int)
        assert pixels.shape[:2] == gallery["QUICK"][::-1]
        shown = np.abs(pixels - pixels[0, 0]).max(axis=-1) > 8
        assert 0.1 < shown.mean() <= 1 and len(np.unique(pixels.reshape(-1, 3), axis=0)) > 16, picture.__name__


def test_the_gallery_page_is_current_and_its_pictures_are_small():
    gallery = module("gallery")
    assert gallery.page() == (DOCS / "gallery.md").read_text(encoding="utf-8"), "run python docs/gallery.py"
    for picture in gallery.PICTURES:
        assert (DOCS / "gallery" / f"{picture.__name__}.png").stat().st_size < 60_000
