"""The fuzzer's whole inputs are read, so that what it counts as refused is refused for the damage; and every way in
which a reader can fail is counted as what it is."""

import argparse
import random
import sys
import time
from collections import Counter

import numpy as np
import pytest
import torch

from e2rl.run.errors import InputError
from tools.fuzz import READERS as NAMES
from tools.fuzz import __main__ as fuzz
from tools.fuzz import child, damage, logs, messages, runs
from tools.fuzz.child import READERS, Watch, outcome
from tools.fuzz.corpus import Corpus
from tools.fuzz.garbage import Garbage, require_plain, require_plausible, same

OWN = [name for name in READERS if name not in ("commonroad", "argoverse2", "pickle_programs", "planner_replies")]


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    return Corpus(tmp_path_factory.mktemp("corpus"), None, None, None)


@pytest.mark.parametrize("name", OWN)
def test_whole_inputs_are_read(corpus, tmp_path, monkeypatch, name):
    for module in (logs, runs, messages):
        for function in ("damaged", "mutated", "torch_file"):
            monkeypatch.setattr(module, function, lambda content, *rest: content, raising=False)
    monkeypatch.setattr(runs, "with_header", lambda content, *rest: content)
    monkeypatch.setattr(runs, "ARRAYS", [np.float64(0.1)])
    draw = random.Random(1)
    monkeypatch.setattr(draw, "random", lambda: 0.5)
    monkeypatch.setattr(draw, "randint", lambda low, high: low)
    getattr(READERS[name](corpus, tmp_path), name)(draw)


def test_whole_plans_of_a_planner_are_read(corpus, tmp_path, monkeypatch):
    monkeypatch.setattr(messages, "replies", lambda draw: whole)
    whole = b"".join(messages.message(messages.ACTION, bytes([row, 0, 0, 0]) + bytes(8)) for row in range(3))
    messages.Messages(corpus, tmp_path).planner_replies(random.Random(0))
    whole = whole[:-1]
    with pytest.raises(InputError):
        messages.Messages(corpus, tmp_path).planner_replies(random.Random(0))


@pytest.fixture(scope="module")
def watch(tmp_path_factory):
    return Watch(tmp_path_factory.mktemp("watched"))


def raises(error):
    def read(draw):
        raise error

    return read


@pytest.mark.parametrize(
    ("read", "expected"),
    [
        (lambda draw: None, "read"),
        (raises(InputError("x")), "refused"),
        (raises(InputError("")), "escaped"),
        (raises(KeyError("x")), "escaped"),
        (raises(Garbage("x")), "garbage"),
        (raises(MemoryError()), "memory"),
        (raises(child.Hang()), "hang"),
        (lambda draw: __import__("os").system("true"), "executed"),
        (lambda draw: __import__("pickle").loads(damage.pickle.dumps(len)), "executed"),
        (lambda draw: open(__file__ + ".elsewhere", "a").close() or raises(InputError("x"))(draw), "executed"),
    ],
)
def test_outcomes_are_what_happened(watch, tmp_path, read, expected):
    try:
        assert outcome(read, random.Random(0), watch, tmp_path / "mark")[0] == expected
    finally:
        __import__("pathlib").Path(__file__ + ".elsewhere").unlink(missing_ok=True)


def test_what_the_input_leaves_behind_counts_as_executed(watch, tmp_path):
    (tmp_path / "mark").touch()
    assert outcome(lambda draw: None, random.Random(0), watch, tmp_path / "mark")[0] == "executed"
    assert not (tmp_path / "mark").exists()


def test_every_reader_is_named():
    assert tuple(READERS) == NAMES


def test_inputs_depend_on_their_number_alone(tmp_path):
    made = [damage.hostile_pickle(random.Random(f"0/x/{number}"), "mark") for number in (3, 4, 3)]
    assert made[0] == made[2] != made[1]


STUB = """
import json, os, signal, sys, time
end, begin = int(sys.argv[1]), int(sys.argv[3].split("=")[1])
print(json.dumps(["stub", None]), flush=True)
print(json.dumps(["stub", begin]), flush=True)
for number in range(begin, end):
    if number == 2:
        os.kill(os.getpid(), signal.SIGSEGV)
    if number == 4:
        time.sleep(1000)
    print(json.dumps(["stub", number, "read", 0.0, ""]), flush=True)
"""


def test_a_child_that_dies_or_waits_forever_costs_one_input_and_a_record_goes_on(tmp_path, monkeypatch):
    (tmp_path / "stub.py").write_text(STUB)
    monkeypatch.setattr(fuzz, "WAIT", 1.0)
    opened = fuzz.subprocess.Popen
    monkeypatch.setattr(
        fuzz.subprocess,
        "Popen",
        lambda command, **given: opened([sys.executable, tmp_path / "stub.py", *command[3:]], **given),
    )
    options = argparse.Namespace(
        count=7, seed=0, record=tmp_path / "record.csv", data=None, commonroad=None, argoverse2=None
    )
    counts = fuzz.run(["stub"], options)
    assert counts == Counter({("stub", "read"): 5, ("stub", "crash"): 1, ("stub", "hang"): 1})
    begun = time.monotonic()
    options.count = 8
    assert fuzz.run(["stub"], options)["stub", "read"] == 6 and time.monotonic() - begun < 20
    assert fuzz.table(counts)[-1] == "| all | 7 | 0 | 5 | 0 | 0 | 1 | 1 | 0 | 0 |"


def test_without_its_library_a_reader_is_not_fuzzed(monkeypatch, capsys):
    monkeypatch.setattr(fuzz, "find_spec", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["fuzz", "3", "--readers", "argoverse2"])
    with pytest.raises(SystemExit):
        fuzz.main()
    assert "the reader argoverse2 needs av2" in capsys.readouterr().err


def test_what_no_reader_may_return_is_known():
    require_plain({"a": [1, "x", np.zeros(3), (None, {2.0})]}, 1 << 10)
    for bad in ({"a": object()}, [len], np.array([len], object)):
        with pytest.raises(Garbage):
            require_plain(bad, 1 << 10)
    with pytest.raises(Garbage, match="more than its bytes"):
        require_plain(np.zeros(1000), 1 << 10)
    assert same({"a": [torch.ones(2), 1]}, {"a": [torch.ones(2), 1]}) and not same([1], [1.0])
    assert not same({"a": torch.ones(2)}, {"a": torch.ones(2).double()})


def test_scenes_that_are_none_are_known(corpus):
    whole = {key: value[0].clone() for key, value in corpus.scenes.scenes.items()}
    require_plausible(whole)
    for key, change in (
        ("logged", lambda value: value.index_fill(-1, torch.tensor(2), 40.0)),
        ("logged", lambda value: value + 1e5),
        ("size", lambda value: value * 100),
        ("start", lambda value: value * torch.nan),
    ):
        with pytest.raises(Garbage):
            require_plausible(whole | {key: change(whole[key])})
