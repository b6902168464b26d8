"""The fuzzer's whole inputs are read, so that what it counts as refused is refused for the damage."""

import random

import pytest

from e2rl.errors import InputError
from e2rl.scene.bundled import load_recordings
from tools import fuzz


@pytest.mark.parametrize("name", fuzz.READERS)
def test_whole_inputs_are_read(tmp_path, monkeypatch, name):
    monkeypatch.setattr(fuzz, "damaged", lambda content, draw: content)
    monkeypatch.setattr(fuzz, "mutated", lambda data, draw: data)
    monkeypatch.setattr(fuzz, "ARRAYS", [])
    scenes = [fuzz.description(recording) for recording in load_recordings("tune")[:2]]
    draw = random.Random(0)
    monkeypatch.setattr(draw, "random", lambda: 0.5)
    assert fuzz.outcome(getattr(fuzz.Readers(scenes, tmp_path, draw), name)) == "read"


def fail(error):
    raise error


def test_only_messages_for_the_user_count_as_refused():
    assert fuzz.outcome(lambda: fail(InputError("x"))) == "refused"
    assert fuzz.outcome(lambda: fail(KeyError("x"))) == "escaped"
