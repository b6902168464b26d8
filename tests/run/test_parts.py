"""Parts that are done are read, whole and of what is asked for, or done again; a stranger's file runs nothing."""

import os
import random

import pytest
import torch

from e2rl.run.parts import Parts, state_bytes

VALUE = ([{"cfr": 1.0, "seed": 3, "duty": ""}], [{"speed": torch.arange(3.0)}], [])


def fail():
    raise AssertionError("done already")


def counted(calls, value=VALUE):
    def compute():
        calls.append(1)
        return value

    return compute


def test_a_part_is_computed_once_and_read_as_it_was(tmp_path):
    Parts(tmp_path, "after").result("a", [("x", 1.5)], lambda: VALUE)
    rows, samples, ended = Parts(tmp_path, "after").result("a", [("x", 1.5)], fail)
    assert (rows, ended) == (VALUE[0], VALUE[2]) and torch.equal(samples[0]["speed"], VALUE[1][0]["speed"])


@pytest.mark.parametrize(
    ("stage", "about", "identity"), [("other", "", [1]), ("", "another round", [1]), ("", "", [2])]
)
def test_a_part_of_something_else_is_none(tmp_path, stage, about, identity):
    Parts(tmp_path).save("a", [1], VALUE)
    calls = []
    Parts(tmp_path, stage, about).result("a", identity, counted(calls))
    assert calls == [1]


def test_every_damage_is_noticed_and_the_part_done_again(tmp_path):
    Parts(tmp_path).save("a", [1], VALUE)
    (file,) = tmp_path.rglob("*.pt")
    whole = file.read_bytes()
    for cut in (0, 1, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:cut])
        assert Parts(tmp_path).load("a", [1]) is None
    draw = random.Random(0)
    for _ in range(200):
        flipped = bytearray(whole)
        flipped[draw.randrange(len(whole))] ^= 1 << draw.randrange(8)
        file.write_bytes(flipped)
        assert Parts(tmp_path).load("a", [1]) is None
    for value in ([1, 2], {"format": "e2rl-part/1"}, "text"):  # whole, but no part
        file.write_bytes(state_bytes(value))
        assert Parts(tmp_path).load("a", [1]) is None
    calls = []
    Parts(tmp_path).result("a", [1], counted(calls))
    assert calls == [1] and Parts(tmp_path).load("a", [1]) is not None


class Malicious:
    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


def test_a_strangers_part_runs_nothing(tmp_path):
    Parts(tmp_path).save("a", [1], VALUE)
    (file,) = tmp_path.rglob("*.pt")
    part = {"format": "e2rl-part/1", "about": "", "identity": [1], "value": Malicious(tmp_path / "ran")}
    file.write_bytes(state_bytes(part))
    assert Parts(tmp_path).load("a", [1]) is None and not (tmp_path / "ran").exists()


def test_a_part_that_is_not_valid_any_more_is_done_again(tmp_path):
    calls = []
    for _ in range(2):
        Parts(tmp_path).result("a", [1], counted(calls), lambda found: False)
    assert len(calls) == 2


def test_without_a_folder_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    calls = []
    for _ in range(2):
        Parts().result("a", [1], counted(calls))
    assert len(calls) == 2 and not list(tmp_path.iterdir())
