"""A file appears whole or not at all."""

from pathlib import Path

import pytest

from e2rl.files import write_atomically


def test_text_bytes_and_writers_are_written(tmp_path):
    folder = tmp_path / "new" / "folder"
    write_atomically(folder / "a", "text")
    write_atomically(folder / "b", b"bytes")
    write_atomically(folder / "c", lambda part: part.write_text("by hand"))
    assert [(folder / name).read_text() for name in "abc"] == ["text", "bytes", "by hand"]


def test_what_fails_on_the_way_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def fail(*_):
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, fail)
    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
