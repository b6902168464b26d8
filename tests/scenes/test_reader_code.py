"""The hash of a reader's code holds what lies beside it."""

import importlib
import sys

from e2rl.scenes.reader_code import code_hash


def test_a_lone_reader_is_hashed_with_the_modules_beside_it(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "helper.py").write_text("def f(): pass\n")
    (tmp_path / "null.py").write_bytes(b"x = 1\0\n")
    (tmp_path / "reader.py").write_text("class Reader:\n    pass\n")
    monkeypatch.delitem(sys.modules, "reader", raising=False)
    importlib.invalidate_caches()
    reader = importlib.import_module("reader").Reader
    before = code_hash(reader)
    assert before
    assert code_hash(reader) == before
    (tmp_path / "helper.py").write_text("def f(): return 1\n")
    assert code_hash(reader) not in (before, None)
    monkeypatch.delitem(sys.modules, "reader", raising=False)
