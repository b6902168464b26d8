"""A file appears whole or not at all; weights read back are those written, and an
altered file is noticed."""

import csv
import hashlib
import io
import json
import multiprocessing
import os
import random
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save

from e2rl.run import files
from e2rl.run.errors import InputError
from e2rl.run.files import (
    SEAL,
    CsvReader,
    alone_in,
    altered,
    csv_text,
    locked,
    write_atomically,
    write_beside,
    written_whole,
)
from e2rl.run.weights import HASH, read_weights, weight_bytes

WEIGHTS = {
    "a": torch.arange(12.0).view(3, 4),
    "b": torch.tensor(3),
    "c": torch.zeros(0, 2, dtype=torch.float64),
}


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
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


def by_path(text):
    """The content of a file as a function that writes it."""
    return lambda path: path.write_text(text)


@pytest.mark.parametrize("content", ["new", b"new", by_path("new")])
def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path, content):
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "file").write_text("old")
    (tmp_path / "far" / "file").chmod(0o600)
    (tmp_path / "second").symlink_to(tmp_path / "far" / "file")
    (tmp_path / "first").symlink_to("second")
    write_atomically(tmp_path / "first", content)
    assert (tmp_path / "first").is_symlink()
    assert (tmp_path / "second").is_symlink()
    assert (tmp_path / "far" / "file").read_text() == "new"
    assert (tmp_path / "far" / "file").stat().st_mode & 0o777 == 0o600
    assert [path.name for path in (tmp_path / "far").iterdir()] == ["file"]


def test_a_link_to_nothing_yet_makes_what_it_leads_to(tmp_path):
    (tmp_path / "link").symlink_to("new/file")
    write_atomically(tmp_path / "link", "text")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "new" / "file").read_text() == "text"


@pytest.mark.parametrize(
    ("umask", "mode"), [(0o077, 0o600), (0o022, 0o644), (0o002, 0o664)]
)
@pytest.mark.parametrize("content", ["new", by_path("new")])
def test_new_files_and_folders_have_the_permissions_that_the_user_wants(
    tmp_path, content, umask, mode
):
    before = os.umask(umask)
    try:
        write_atomically(tmp_path / "file", content)
        with written_whole(tmp_path / "folder") as folder:
            (folder / "file").write_text("new")
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == mode
    assert (tmp_path / "folder").stat().st_mode & 0o777 == 0o777 & ~umask


@pytest.mark.parametrize("letter", ["a", "\N{OGHAM LETTER BEITH}"])
def test_a_name_may_be_as_long_as_the_disk_allows(tmp_path, letter):
    name = letter * (255 // len(letter.encode()))
    write_atomically(tmp_path / name, "new")
    with written_whole(tmp_path / name[1:]):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {name, name[1:]}


@pytest.mark.parametrize("content", ["new", by_path("new")])
def test_a_device_is_written_through_and_nothing_beside_it(tmp_path, content):
    """Another node of /dev/null, so that a mistake does not replace the machine's."""
    device = tmp_path / "null.png"
    try:
        os.mknod(device, 0o600 | 0o020000, os.makedev(1, 3))
        device.write_bytes(b"")
    except OSError:
        pytest.skip("needs a user who can make a device")
    (tmp_path / "link.png").symlink_to(device)
    for path in (device, tmp_path / "link.png"):
        write_atomically(path, content)
        write_beside(path, ".pdf", content=content)
    assert device.is_char_device()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.png", "null.png"]


@pytest.mark.parametrize("content", ["new", by_path("new")])
def test_a_pipe_is_written_through(tmp_path, content):
    os.mkfifo(tmp_path / "pipe")
    read = []
    reader = threading.Thread(
        target=lambda: read.append((tmp_path / "pipe").read_text())
    )
    reader.start()
    write_atomically(tmp_path / "pipe", content)
    reader.join(20)
    assert read == ["new"]
    assert (tmp_path / "pipe").is_fifo()


PRINTS = """
import sys
from pathlib import Path
from e2rl.run.files import write_atomically
print("before")
write_atomically(Path(sys.argv[1]), "content\\n")
print("after")
"""


@pytest.mark.parametrize("into", ["file", "pipe", "socket"])
def test_standard_output_is_written_in_turn_whatever_it_is(tmp_path, into):
    """An output that is a file is not replaced, or what is printed next would be lost."""
    command = [sys.executable, "-c", PRINTS, "/dev/stdout"]
    if into == "pipe":
        said = subprocess.run(
            command, stdout=subprocess.PIPE, check=True, timeout=60
        ).stdout
    elif into == "file":
        with (tmp_path / "out").open("wb") as file:
            subprocess.run(command, stdout=file, check=True, timeout=60)
        said = (tmp_path / "out").read_bytes()
    else:
        here, place = socket.socketpair()
        with here, place:
            subprocess.run(command, stdout=place, check=True, timeout=60)
            said = here.recv(1000)
    assert said == b"before\ncontent\nafter\n"


@pytest.mark.parametrize(
    "kind", ["folder", "socket", "read-only", "loop", "link to a folder"]
)
def test_what_is_no_file_is_refused_by_its_name_and_stays(tmp_path, kind):
    path = tmp_path / "target"
    if kind == "folder":
        path.mkdir()
    elif kind == "socket":
        server = socket.socket(socket.AF_UNIX)
        server.bind(str(path))
        server.close()
    elif kind == "read-only":
        path.write_text("old")
        path.chmod(0o444)
    else:
        path.symlink_to(path if kind == "loop" else tmp_path)
    before = path.lstat()
    with pytest.raises(OSError) as refused:
        write_atomically(path, "new")
    assert refused.value.filename == str(path)
    assert path.lstat() == before
    assert [item.name for item in tmp_path.iterdir()] == ["target"]


def test_what_comes_beside_a_file_follows_no_link_out_of_its_folder(tmp_path):
    """A stranger's run may hold one, and the user has named the file alone."""
    (tmp_path / "run").mkdir()
    (tmp_path / "user").write_text("a user's")
    (tmp_path / "run" / "page.csv").symlink_to(tmp_path / "user")
    with pytest.raises(PermissionError, match="a link out of its folder"):
        write_beside(tmp_path / "run" / "page.html", ".csv", content="new")
    assert (tmp_path / "user").read_text() == "a user's"


# --- CSV

FORMULAS = [
    "=1+1",
    "+1+1",
    "-1+1",
    "@SUM(A1)",
    "\t=1",
    "\r=1",
    " =1",
    "\uff1d1",
    '=HYPERLINK("http://x","y")',
    "'=1",
]
NUMBERS = [
    "-1",
    "+2.5",
    "-3e-5",
    "-.5",
    "+2.1 [+0.4, +3.9]*",
    "-2.1 [-4.0, -0.2]* (12)",
]


@pytest.mark.parametrize("text", FORMULAS)
def test_no_cell_begins_as_a_formula(text):
    ((cell,),) = csv.reader(io.StringIO(csv_text([[text]]), newline=""))
    assert cell == f"'{text}"


def test_numbers_and_other_words_stay_as_they_are():
    values = [*NUMBERS, -1.5, 7, "", "scene-1", "a=b", "'quoted'", "\u2013"]
    assert next(csv.reader([csv_text([values])])) == list(map(str, values))


@settings(max_examples=300, deadline=None)
@given(
    st.lists(
        st.text(st.sampled_from("'=+-@\t\r\n ,\"1e.a\uff1d"), max_size=6),
        min_size=1,
        max_size=3,
    )
)
def test_cells_are_read_as_they_were(texts):
    rows = CsvReader(
        io.StringIO(csv_text([["=head", *texts], ["x", *texts]]), newline="")
    )
    assert list(rows.fieldnames) == ["=head", *texts]
    assert next(rows) == dict(zip(["=head", *texts], ["x", *texts], strict=True))


# --- folders


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    with written_whole(tmp_path / "new" / "folder") as part:
        (part / "a").write_text("text")
        assert not (tmp_path / "new" / "folder").exists()
    assert (tmp_path / "new" / "folder" / "a").read_text() == "text"
    with (
        pytest.raises(KeyboardInterrupt),
        written_whole(tmp_path / "new" / "other") as part,
    ):
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
    workers = [
        context.Process(target=hold, args=(tmp_path / "x", tmp_path / "log"))
        for _ in range(8)
    ]
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


def test_one_run_at_a_time_is_at_work_in_a_folder_until_it_is_killed(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(files, "WAIT", 1)
    context = multiprocessing.get_context("fork")
    inside = context.Event()
    other = context.Process(target=stay, args=(tmp_path, inside))
    other.start()
    assert inside.wait(20)
    with (
        pytest.raises(InputError, match="another process is at work"),
        alone_in(tmp_path),
    ):
        pass
    other.kill()
    other.join(20)
    with alone_in(tmp_path):
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["/dev/zero", "../outside", "pipe", "link"])
def test_a_seal_counts_for_files_of_its_folder_only(tmp_path, name):
    """It is a stranger's, too: no hash of an endless device, of a file elsewhere, or of
    a pipe that nobody writes."""
    folder = tmp_path / "sealed"
    folder.mkdir()
    (tmp_path / "outside").write_text("")
    os.mkfifo(folder / "pipe")
    (folder / "link").symlink_to(tmp_path / "outside")
    (folder / SEAL).write_text(json.dumps({name: hashlib.sha256(b"").hexdigest()}))
    assert altered(folder) is not None


# --- weights


def test_what_is_written_is_read_and_equal_weights_make_equal_bytes(tmp_path):
    path = tmp_path / "x.safetensors"
    header = {"architecture": "small", "kind": "actor", "version": "1"}
    assert len({weight_bytes(dict(WEIGHTS), dict(header)) for _ in range(20)}) == 1
    path.write_bytes(weight_bytes(WEIGHTS, header))
    weights, read = read_weights(path)
    assert read == header
    assert set(weights) == set(WEIGHTS)
    assert all(
        torch.equal(value, WEIGHTS[key]) and value.dtype == WEIGHTS[key].dtype
        for key, value in weights.items()
    )


@pytest.mark.parametrize("seed", range(20))
def test_a_flipped_bit_changes_no_weight_in_silence(tmp_path, seed):
    """It is noticed wherever it is but in the name of the hash, where it changes
    nothing else."""
    content = bytearray(weight_bytes(WEIGHTS, {"architecture": "small"}))
    draw = random.Random(seed)
    content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    (tmp_path / "x.safetensors").write_bytes(content)
    try:
        weights, header = read_weights(tmp_path / "x.safetensors")
    except ValueError:
        return
    assert HASH.encode() not in content
    assert header["architecture"] == "small"
    assert all(torch.equal(value, WEIGHTS[key]) for key, value in weights.items())


def test_files_without_a_hash_are_read_but_not_with_nan(tmp_path):
    path = tmp_path / "x.safetensors"
    path.write_bytes(save(WEIGHTS, {"architecture": "small"}))
    assert read_weights(path)[1] == {"architecture": "small"}
    path.write_bytes(weight_bytes(WEIGHTS | {"a": torch.tensor([1.0, torch.nan])}, {}))
    with pytest.raises(ValueError, match="a holds NaN"):
        read_weights(path)
