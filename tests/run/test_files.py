"""A file appears whole or not at all."""

import multiprocessing
import time
from pathlib import Path

import pytest

from e2rl.run import files
from e2rl.run.errors import InputError
from e2rl.run.files import alone_in, locked, write_atomically, written_whole


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


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    with written_whole(tmp_path / "new" / "folder") as part:
        (part / "a").write_text("text")
        assert not (tmp_path / "new" / "folder").exists()
    assert (tmp_path / "new" / "folder" / "a").read_text() == "text"
    with pytest.raises(KeyboardInterrupt), written_whole(tmp_path / "new" / "other") as part:
        (part / "a").write_text("text")
        raise KeyboardInterrupt
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["folder"]


def hold(path, log):
    with locked(path):
        with log.open("a") as file:
            file.write("in\n")
        time.sleep(0.05)
        with log.open("a") as file:
            file.write("out\n")


def test_one_process_at_a_time_holds_a_lock_and_it_leaves_no_file(tmp_path):
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=hold, args=(tmp_path / "x", tmp_path / "log")) for _ in range(8)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(20)
    assert (tmp_path / "log").read_text() == "in\nout\n" * 8
    assert [path.name for path in tmp_path.iterdir()] == ["log"]


def stay(folder, inside):
    with alone_in(folder):
        inside.set()
        time.sleep(30)


def test_one_run_at_a_time_is_at_work_in_a_folder_until_it_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "WAIT", 1)
    context = multiprocessing.get_context("fork")
    inside = context.Event()
    other = context.Process(target=stay, args=(tmp_path, inside))
    other.start()
    assert inside.wait(20)
    with pytest.raises(InputError, match="another process is at work"), alone_in(tmp_path):
        pass
    other.kill()
    other.join(20)
    for _ in range(2):
        with alone_in(tmp_path):
            assert not list(tmp_path.iterdir())
