"""The hash of a reader's code holds what it imports, whatever else it tries to import."""

import importlib
import sys

import pytest

from e2rl.scenes.reader_code import code_hash

CATCHES = "try:\n    import {0}\nexcept (SyntaxError, ValueError):\n    {0} = None\n"
READERS = {  # a reader's first lines, which import `helper`
    "out of its package": "try:\n    from .helper import f\n"
    "except ImportError:\n    from helper import f\n",
    "of another Python": "import helper\n" + CATCHES.format("old"),
    "that holds a null byte": "import helper\n" + CATCHES.format("null"),
}


@pytest.mark.parametrize("kind", READERS)
def test_a_reader_may_catch_what_it_cannot_import(
    tmp_path,
    monkeypatch,
    kind,
):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "helper.py").write_text("def f(): pass\n")
    (tmp_path / "old.py").write_text("print 'of Python 2'\n")
    (tmp_path / "null.py").write_bytes(b"x = 1\0\n")
    (tmp_path / "reader.py").write_text(f"{READERS[kind]}class Reader:\n    pass\n")
    for name in ("reader", "helper"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    importlib.invalidate_caches()
    reader = importlib.import_module("reader").Reader
    before = code_hash(reader)
    (tmp_path / "helper.py").write_text("def f(): return 1\n")
    assert before
    assert code_hash(reader) not in (before, None)
    for name in ("reader", "helper"):
        monkeypatch.delitem(sys.modules, name, raising=False)
