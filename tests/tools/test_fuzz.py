"""The fuzzer reads whole inputs, so that what it counts as refused is refused for the
damage, and knows what is bad."""

import os
import pickle
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings

from e2rl.run.errors import InputError
from tests.scenes.descriptions import description
from tools import fuzz
from tools.fuzz import Watch, outcome
from tools.fuzz_commands import ended
from tools.fuzz_inputs import Garbage, hostile
from tools.fuzz_readers import Readers, require_plain


@pytest.fixture(scope="module")
def watch(tmp_path_factory):
    return Watch(tmp_path_factory.mktemp("watched"))


def raises(error):
    def read(content):
        raise error

    return read


@pytest.mark.parametrize(
    ("read", "expected"),
    [
        (lambda content: None, "read"),
        (raises(InputError("x")), "refused"),
        (raises(InputError("")), "escaped"),
        (raises(KeyError("x")), "escaped"),
        (raises(Garbage("x")), "garbage"),
        (raises(MemoryError()), "memory"),
        (raises(fuzz.Hang()), "hang"),
        (lambda content: pickle.loads(pickle.dumps(len)), "executed"),
        (lambda content: os.mkdir("/nowhere/at-all"), "executed"),
        (lambda content: os.symlink("x", "/nowhere/at-all"), "executed"),
        (lambda content: Path("/nowhere/at-all").write_text("x"), "executed"),
        (lambda content: subprocess.run(["nothing"]), "executed"),
    ],
)
def test_outcomes_are_what_happened(watch, tmp_path, read, expected):
    assert outcome(read, b"", watch=watch, mark=tmp_path / "mark")[0] == expected


def test_a_command_is_refused_by_one_line_and_no_other_way():
    ended(None, "any warning")
    with pytest.raises(InputError, match="error: of the user"):
        ended(2, "a warning\nerror: of the user")
    for status, said in (
        (1, "Traceback\nerror: x"),
        (2, ""),
        (-9, ""),
        (2, "error: x\nerror: y"),
    ):
        with pytest.raises(Garbage):
            ended(status, said)


def test_what_an_input_leaves_behind_counts_as_executed(watch, tmp_path):
    (tmp_path / "mark").touch()
    assert (
        outcome(lambda content: None, b"", watch=watch, mark=tmp_path / "mark")[0]
        == "executed"
    )
    assert not (tmp_path / "mark").exists()


def test_whole_inputs_are_read_and_hostile_ones_run_nothing(tmp_path, watch):
    readers = Readers(tmp_path, None)
    for name in ("pickles", "descriptions"):
        _, read = getattr(readers, name)()
        read(pickle.dumps(description()))
    result = Counter()

    @settings(max_examples=40, database=None, deadline=None)
    @given(hostile(str(readers.mark)))
    def each(content):
        result[
            outcome(readers.pickles()[1], content, watch=watch, mark=readers.mark)[0]
        ] += 1

    each()
    assert result["refused"] > 20
    assert not set(result) - set(fuzz.GOOD)


def test_what_no_reader_may_return_is_known():
    require_plain({"a": [1, "x", np.zeros(3), (None, {2.0})]}, 1 << 10)
    for bad in ({"a": object()}, [len], np.array([len], object), np.zeros(1000)):
        with pytest.raises(Garbage):
            require_plain(bad, 1 << 10)
