"""The fuzzer's child process: reads inputs, and notes what they do."""

import argparse
import json
import os
import random
import resource
import signal
import sys
import time
import traceback
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from e2rl.run.errors import InputError
from tools.fuzz import LIMIT
from tools.fuzz.corpus import Corpus
from tools.fuzz.garbage import Garbage
from tools.fuzz.logs import Logs
from tools.fuzz.messages import Messages
from tools.fuzz.runs import Runs

MEMORY = 1 << 31  # bytes beyond what the libraries take
FORBIDDEN = ("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "pty.spawn")
FORBIDDEN += ("subprocess.Popen", "socket.connect", "socket.bind", "socket.getaddrinfo", "pickle.find_class")
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
HELPERS = ("folders", "scenes")
READERS = {
    name: kind
    for kind in (Logs, Runs, Messages)
    for name in vars(kind)
    if not name.startswith("_") and name not in HELPERS
}


class Hang(BaseException):
    """An input takes too long."""


class Watch:
    """Notes what code that runs in an input would do; inputs are written into `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.seen, self.on = str(folder), "", False
        sys.addaudithook(self._audit)

    def _audit(self, event: str, arguments: tuple) -> None:
        if not self.on:
            return
        if event in FORBIDDEN:
            self.seen = event
        elif event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITES:
            path = arguments[0]
            if isinstance(path, str | bytes) and not os.path.abspath(os.fsdecode(path)).startswith(self.folder):
                self.seen = f"open {os.fsdecode(path)[:100]} for writing"


def main() -> None:
    """Read inputs of the readers; an outcome a line on standard output, after a line for each reader that begins."""
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz.child", description=__doc__)
    parser.add_argument("end", type=int, help="number of the first input that is not read")
    parser.add_argument("seed", type=int)
    parser.add_argument("first", nargs="+", metavar="READER=NUMBER", help="readers, and their first inputs")
    for name in ("--data", "--commonroad", "--argoverse2"):
        parser.add_argument(name)
    options = parser.parse_args()
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print
    warnings.filterwarnings("ignore")
    signal.signal(signal.SIGPROF, _hangs)
    with TemporaryDirectory() as folder:
        (Path(folder) / "corpus").mkdir()
        corpus = Corpus(Path(folder) / "corpus", options.data, options.commonroad, options.argoverse2)
        watch = Watch(Path(folder))
        for reader, begin in (first.split("=") for first in options.first):
            print(json.dumps([reader, None]), file=out, flush=True)  # it prepares
            inputs = READERS[reader](corpus, Path(folder))
            read = getattr(inputs, reader)
            _warm(read)
            used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.RLIM_INFINITY))
            print(json.dumps([reader, int(begin)]), file=out, flush=True)
            for number in range(int(begin), options.end):
                draw = random.Random(f"{options.seed}/{reader}/{number}")
                row = [reader, number, *outcome(read, draw, watch, Path(inputs.mark))]
                print(json.dumps(row), file=out, flush=True)


def _warm(read: Any) -> None:
    """Whole inputs are made and libraries loaded by some inputs that do not count."""
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    for number in range(3):
        try:
            read(random.Random(f"first/{number}"))
        except Exception:
            continue


def _hangs(*_: Any) -> None:
    raise Hang


def outcome(read: Any, draw: random.Random, watch: Watch, mark: Path) -> tuple[str, float, str]:
    """What came of one input, in how many seconds of the processor; a note on what is bad."""
    begin, result, note, watch.seen, watch.on = time.process_time(), "read", "", "", True
    try:
        signal.setitimer(signal.ITIMER_PROF, LIMIT)
        read(draw)
    except InputError as error:
        result, note = ("refused", "") if str(error) else ("escaped", "an InputError without a word")
    except Garbage as error:
        result, note = "garbage", str(error)
    except MemoryError as error:
        result, note = "memory", place(error)
    except Hang as error:
        result, note = "hang", place(error)
    except Exception as error:
        result, note = "escaped", place(error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        watch.on = False
    if watch.seen or mark.exists():
        result, note = "executed", watch.seen or "the mark is there"
        mark.unlink(missing_ok=True)
    return result, round(time.process_time() - begin, 4), note


def place(error: BaseException) -> str:
    """An exception with the last line of the package that it passed."""
    lines = [frame for frame in traceback.extract_tb(error.__traceback__) if "e2rl" in Path(frame.filename).parts]
    at = f" at {Path(lines[-1].filename).name}:{lines[-1].lineno}" if lines else ""
    return f"{type(error).__name__}: {str(error)[:200]}{at}"


if __name__ == "__main__":
    main()
