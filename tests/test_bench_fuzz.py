"""The reader of damaged files: what it counts, and that it finds what it looks for."""

import numpy as np
import pytest

import clsurf
from bench import fuzz


def test_damage_is_repeatable_and_changes_files():
    whole = bytes(range(256)) * 4
    made = [fuzz.damaged(whole, np.random.default_rng(5)) for _ in range(2)]
    assert made[0] == made[1]
    random = np.random.default_rng(1)
    assert sum(fuzz.damaged(whole, random) != whole for _ in range(50)) > 40


def test_the_reader_tells_what_became_of_a_file(tmp_path):
    clsurf.save(clsurf.models.torus(50), tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes(b"ply\ngarbage")
    reader = fuzz.Reader()
    try:
        assert reader.read(tmp_path / "a.ply")[0] == "read"
        assert reader.read(tmp_path / "b.ply")[0] == "refused"
    finally:
        reader.stop()


@pytest.mark.parametrize("text, word", [("import os; os._exit(3)", "ended:3"), ("raise KeyError", "raised:KeyError"),
                                        ("time.sleep(99)", "hung"), ("x = bytearray(1 << 28); del x", "memory")])
def test_a_reader_that_fails_is_seen(tmp_path, monkeypatch, text, word):
    """A process that ends, raises, hangs or takes memory instead of reading."""
    path = tmp_path / "a.ply"
    clsurf.save(clsurf.models.torus(50), path)
    monkeypatch.setattr(fuzz, "READER", fuzz.READER.replace("load(line.rstrip(chr(10)))", f"exec({text!r})"))
    monkeypatch.setattr(fuzz, "SECONDS", 0.5)
    reader = fuzz.Reader()
    try:
        got, _, memory = reader.read(path)
    finally:
        reader.stop()
    assert memory > 1 << 27 if word == "memory" else got == word
