"""A file appears whole or not at all; weights read back are those written, and an altered file is noticed."""

import hashlib
import json
import multiprocessing
import os
import random
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import save

from e2rl.run import files
from e2rl.run.errors import InputError
from e2rl.run.files import (
    HASH,
    SEAL,
    alone_in,
    altered,
    locked,
    read_weights,
    weight_bytes,
    write_atomically,
    written_whole,
)

WEIGHTS = {"a": torch.arange(12.0).view(3, 4), "b": torch.tensor(3), "c": torch.zeros(0, 2, dtype=torch.float64)}


def test_what_fails_on_the_way_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "new" / "file"
    write_atomically(path, "old")

    def fail(*_):
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, fail)
    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old" and list(path.parent.iterdir()) == [path]


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
    with alone_in(tmp_path):
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["/dev/zero", "../outside", "pipe", "link"])
def test_a_seal_counts_for_files_of_its_folder_only(tmp_path, name):
    """It is a stranger's, too: no hash of an endless device, of a file elsewhere, or of a pipe that nobody writes."""
    folder = tmp_path / "sealed"
    folder.mkdir()
    (tmp_path / "outside").write_text("")
    os.mkfifo(folder / "pipe")
    (folder / "link").symlink_to(tmp_path / "outside")
    (folder / SEAL).write_text(json.dumps({name: hashlib.sha256(b"").hexdigest()}))
    assert altered(folder) is not None


# --- weights


def test_what_is_written_is_read_and_equal_weights_make_equal_bytes(tmp_path):
    path, header = tmp_path / "x.safetensors", {"architecture": "small", "kind": "actor", "version": "1"}
    assert len({weight_bytes(dict(WEIGHTS), dict(header)) for _ in range(20)}) == 1
    path.write_bytes(weight_bytes(WEIGHTS, header))
    weights, read = read_weights(path)
    assert read == header and set(weights) == set(WEIGHTS)
    assert all(torch.equal(value, WEIGHTS[key]) and value.dtype == WEIGHTS[key].dtype for key, value in weights.items())


@pytest.mark.parametrize("seed", range(20))
def test_a_flipped_bit_changes_no_weight_in_silence(tmp_path, seed):
    """It is noticed wherever it is but in the name of the hash, where it changes nothing else."""
    content, draw = bytearray(weight_bytes(WEIGHTS, {"architecture": "small"})), random.Random(seed)
    content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    (tmp_path / "x.safetensors").write_bytes(content)
    try:
        weights, header = read_weights(tmp_path / "x.safetensors")
    except ValueError:
        return
    assert HASH.encode() not in content and header["architecture"] == "small"
    assert all(torch.equal(value, WEIGHTS[key]) for key, value in weights.items())


def test_files_without_a_hash_are_read_but_not_with_nan(tmp_path):
    path = tmp_path / "x.safetensors"
    path.write_bytes(save(WEIGHTS, {"architecture": "small"}))
    assert read_weights(path)[1] == {"architecture": "small"}
    path.write_bytes(weight_bytes(WEIGHTS | {"a": torch.tensor([1.0, torch.nan])}, {}))
    with pytest.raises(ValueError, match="a holds NaN"):
        read_weights(path)
