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


def test_whole_files_of_every_format_are_read(device, tmp_path):
    """What is damaged later is good before; a copy of a store damages one file and leaves the whole one alone."""
    found, reader = fuzz.seeds(tmp_path, device), fuzz.Reader()
    assert {seed.how for seed in found.values()} == {"load", "cameras", "path", "picture", "stored"}
    store, words = found["folder .clsurf"], []
    before = {path: path.read_bytes() for path in store.folder.rglob("*") if path.is_file()}
    try:
        for name, seed in found.items():
            assert (name, reader.read(seed.folder / seed.read, seed.how)[0]) == (name, "read")
        for i in range(30):
            copy = fuzz.damaged_copy(store, tmp_path / f"copy {i}", np.random.default_rng(i))
            words.append(reader.read(copy, "stored")[0])
    finally:
        reader.stop()
    assert set(words) == {"read", "refused"}
    assert all(path.read_bytes() == whole for path, whole in before.items())


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
    monkeypatch.setattr(fuzz, "READER", fuzz.READER.replace("READ[how](path)", f"exec({text!r})"))
    monkeypatch.setattr(fuzz, "SECONDS", 0.5)
    reader = fuzz.Reader()
    try:
        got, _, memory = reader.read(path)
    finally:
        reader.stop()
    assert memory > 1 << 27 if word == "memory" else got == word


def test_answers_that_come_at_once_are_no_hang(monkeypatch, tmp_path):
    monkeypatch.setattr(fuzz, "READER", 'import sys, time\nprint("ready", flush=True)\n'
                        'asked = [sys.stdin.readline() for _ in range(3)]\n'
                        'print("read 0 0\\nrefused 1 2\\nread 0 0", flush=True)\ntime.sleep(99)')
    monkeypatch.setattr(fuzz, "SECONDS", 0.5)
    reader = fuzz.Reader()
    try:
        assert reader.read_all([tmp_path] * 3) == [("read", 0.0, 0), ("refused", 1.0, 2), ("read", 0.0, 0)]
    finally:
        reader.stop()
