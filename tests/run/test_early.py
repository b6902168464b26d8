"""What commands import first."""

import subprocess
import sys

PROGRAM = """
import gc
import e2rl.run.early
loading = gc.isenabled()
from e2rl.run.endings import ending
with ending():
    print(loading, gc.isenabled())
"""


def test_garbage_is_collected_once_the_libraries_are_there():
    output = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    ).stdout
    assert output.split() == ["False", "True"]
