"""What commands import first."""

import subprocess
import sys

PROGRAM = """
import gc
from e2rl.run.early import loading
first = gc.isenabled()
from e2rl.run.endings import ending
with ending():
    print(first, gc.isenabled())
    with loading():
        print(gc.isenabled())
    print(gc.isenabled(), gc.get_freeze_count() > 0)
"""


def test_garbage_is_collected_once_the_libraries_are_there():
    output = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    ).stdout
    words = output.split()
    assert words[:2] == ["False", "True"]
    assert words[2:] == ["False", "True", "True"], "of a command that has begun already"
