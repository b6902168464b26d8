#!/usr/bin/env bash
# pytest-xdist's --dist loadgroup ignores the mark xdist_group under pytest 9.2: tests of one group run in several processes.
#
# xdist's documentation: tests marked with one group name run in the same worker. It appends @GROUP to each item's _nodeid in the
# worker, and the scheduler reads it from the collected ids. pytest 9.2 answers nodeid from a structured id and never reads _nodeid,
# so the scheduler sees no group and nothing is said. Four tests of one group, in two workers: with pytest 9.0.2 one process, with
# 9.2.0 two. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/test_group.py" <<'PYTHON'
import os
import pathlib
import time

import pytest


@pytest.mark.xdist_group("one")
@pytest.mark.parametrize("number", range(4))
def test_group(number):
    time.sleep(0.5)
    pathlib.Path(os.environ["SEEN"], str(os.getpid())).touch()
PYTHON
processes() {  # PYTEST
    python3 -m venv "$folder/$1"
    "$folder/$1/bin/pip" install -q "pytest==$1" pytest-xdist==3.8.0
    mkdir "$folder/seen-$1"
    (cd "$folder" && SEEN=$folder/seen-$1 "$folder/$1/bin/python" -m pytest -q -p no:cacheprovider -n 2 --dist loadgroup test_group.py) >&2
    ls "$folder/seen-$1" | wc -l
}
older=$(processes 9.0.2)
newer=$(processes 9.2.0)
echo "pytest-xdist 3.8.0, one group in two workers: $older process with pytest 9.0.2, $newer with pytest 9.2.0"
[ "$older" = 1 ] && [ "$newer" = 2 ]
