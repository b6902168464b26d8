"""Parts that are done are read, whole and of what is asked for, or done again; a
stranger's file runs nothing."""

import hashlib
import io
import os
import random
import zipfile

import pytest
import torch

from e2rl.run.parts import HASHED, Parts, state_bytes

VALUE = ([{"cfr": 1.0, "seed": 3, "duty": ""}], [{"speed": torch.arange(3.0)}], [])


def computes(parts, name="a", identity=(1,), **options):
    """Whether a part is computed, not read."""
    calls = []

    def compute():
        calls.append(1)
        return VALUE

    parts.result(name, list(identity), compute, **options)
    return bool(calls)


@pytest.fixture
def file(tmp_path):
    """The file of a part."""
    assert computes(Parts(tmp_path))
    (result,) = tmp_path.rglob("*.pt")
    return result


def test_a_part_is_computed_once_and_read_as_it_was(tmp_path, file, monkeypatch):
    assert not computes(Parts(tmp_path))
    rows, samples, errored = Parts(tmp_path).load("a", [1])
    assert (rows, errored) == (VALUE[0], VALUE[2])
    assert torch.equal(samples[0]["speed"], VALUE[1][0]["speed"])
    monkeypatch.chdir(tmp_path / "parts")
    assert computes(Parts())
    assert computes(Parts()), "without a folder nothing is written"
    assert computes(Parts(tmp_path), valid=lambda found: False)


@pytest.mark.parametrize(
    ("stage", "about", "identity"),
    [("other", "", [1]), ("", "another round", [1]), ("", "", [2])],
)
def test_a_part_of_something_else_is_none(tmp_path, file, stage, about, identity):
    assert computes(Parts(tmp_path, stage, about=about), identity=identity)


def test_every_damage_is_noticed_and_the_part_done_again(tmp_path, file):
    whole = file.read_bytes()
    draw = random.Random(0)
    for cut in (0, 1, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:cut])
        assert Parts(tmp_path).load("a", [1]) is None
    for _ in range(200):
        flipped = bytearray(whole)
        flipped[draw.randrange(len(whole))] ^= 1 << draw.randrange(8)
        file.write_bytes(flipped)
        assert Parts(tmp_path).load("a", [1]) is None
    older = {"format": "e2rl-part/0", "about": "", "identity": [1], "value": 1}
    for value in ([1, 2], {"format": "e2rl-part/1"}, older, "text"):  # no part
        file.write_bytes(state_bytes(value))
        assert Parts(tmp_path).load("a", [1]) is None
    assert computes(Parts(tmp_path))
    assert Parts(tmp_path).load("a", [1]) is not None


class Malicious:
    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


def test_a_strangers_part_runs_nothing(tmp_path, file):
    part = {
        "format": "e2rl-part/1",
        "about": "",
        "identity": [1],
        "value": Malicious(tmp_path / "ran"),
    }
    file.write_bytes(state_bytes(part))
    assert Parts(tmp_path).load("a", [1]) is None
    assert not (tmp_path / "ran").exists()


def packed():
    """A part that grows a thousandfold as it is read."""
    content = io.BytesIO()
    small = io.BytesIO()
    torch.save(
        {
            "format": "e2rl-part/1",
            "about": "",
            "identity": [1],
            "value": torch.zeros(10**6),
        },
        content,
    )
    with (
        zipfile.ZipFile(content) as full,
        zipfile.ZipFile(small, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for name in full.namelist():
            archive.writestr(name, full.read(name))
    return HASHED + hashlib.sha256(small.getvalue()).digest() + small.getvalue()


def test_a_part_that_grows_as_it_is_read_is_none(tmp_path, file):
    part = {"format": "e2rl-part/1", "about": "", "identity": [1]}
    for content in (
        packed(),
        state_bytes(part | {"value": torch.zeros(1).expand(2**20, 2**20)}),
    ):
        assert len(content) < 10**5
        file.write_bytes(content)
        assert Parts(tmp_path).load("a", [1]) is None


def test_a_part_is_a_file_of_the_run_s_folder(tmp_path, file):
    elsewhere = file.rename(tmp_path.parent / f"{tmp_path.name}.pt")
    file.symlink_to(elsewhere)
    assert Parts(tmp_path).load("a", [1]) is None
    file.unlink()
    os.mkfifo(file)
    assert computes(Parts(tmp_path))
    assert not computes(Parts(tmp_path))
