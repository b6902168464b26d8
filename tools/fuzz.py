"""python -m tools.fuzz N [READER ...] [--seed S] [--data LOGS] [--keep FOLDER]: N
malformed inputs for each reader.

The readers are those of files and messages that strangers may have written
(tools/fuzz_readers.py), among them whole commands on a stranger's folder
(tools/fuzz_commands.py). Inputs are drawn by hypothesis: whole ones with bytes or
values changed, and what a hostile author might write. Each is read in a child process
of limited memory and time, in which an audit hook notes what runs code. Outcomes:

| refused | by the program's own error, which names the file |
| read | as what the whole input says, or as another plausible value |
| escaped | another exception |
| garbage | read as something that it is not; a user's file was changed |
| hang, crash, memory | over LIMIT seconds of the processor or WALL of the clock; the child died; over MEMORY bytes |
| executed | code of the input ran, or a process, a connection or a file elsewhere was opened |

The exit status is 1 where any but the first two came out; --keep writes those inputs
into a folder.
"""

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings

from e2rl.run.errors import InputError
from tools.fuzz_commands import ROOT, RUN
from tools.fuzz_inputs import Garbage
from tools.fuzz_readers import Readers

LIMIT, WALL, WAIT = (
    10.0,
    120.0,
    600.0,
)  # s for one input; the last: for a child, besides WALL / 20 for each
MEMORY = 1 << 31  # bytes beyond those of the libraries
GOOD = ("refused", "read")
FORBIDDEN = (
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.fork",
    "os.forkpty",
    "pty.spawn",
)
FORBIDDEN += (
    "socket.connect",
    "socket.bind",
    "socket.getaddrinfo",
    "pickle.find_class",
)
STARTED = (sys.executable, "git")  # programs that commands start themselves
CHANGING = (
    "os.mkdir",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.truncate",
    "os.chmod",
    "os.link",
    "os.symlink",
)
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


class Hang(BaseException):
    """An input takes too long."""


# --- the child, which reads


class Watch:
    """Notes what code that runs in an input would do; inputs are written below
    `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = str(folder)
        self.seen = ""
        self.on = False
        sys.addaudithook(self._audit)

    def _audit(self, event: str, arguments: tuple) -> None:
        if not self.on:
            return
        started = event == "subprocess.Popen" and arguments[1][0] not in STARTED
        if started or (event in FORBIDDEN and not _by_workers()):
            self.seen = f"{event} {str(arguments)[:100]}"
        elif (
            event == "open"
            and isinstance(arguments[2], int)
            and arguments[2] & WRITES
            or event in CHANGING
        ):
            paths = (
                arguments[1:2]
                if event in ("os.link", "os.symlink")
                else arguments[: 1 + (event == "os.rename")]
            )
            outside = [
                each
                for each in paths
                if isinstance(each, str | bytes) and not self.inside(os.fsdecode(each))
            ]
            if outside:
                self.seen = f"{event} {os.fsdecode(outside[0])[:100]}"

    def inside(self, path: str) -> bool:
        """Whether a path may be written."""
        return os.path.abspath(path).startswith(self.folder) or path == os.devnull


def _by_workers() -> bool:
    """Whether the program's own processes are at work: what they send back is pickled."""
    frame = sys._getframe()
    while frame := frame.f_back:  # type: ignore[assignment]
        if "/multiprocessing/" in frame.f_code.co_filename:
            return True
    return False


def outcome(
    read: Callable[[bytes], Any], content: bytes, watch: Watch, mark: Path
) -> tuple[str, str]:
    """What came of one input, and a note on what is bad."""
    result = "read"
    note = ""
    watch.seen = ""
    watch.on = True
    try:
        signal.setitimer(signal.ITIMER_PROF, LIMIT)
        signal.setitimer(signal.ITIMER_REAL, WALL)
        read(content)
    except InputError as error:
        result, note = (
            ("refused", "")
            if str(error)
            else ("escaped", "an InputError without a word")
        )
    except Garbage as error:
        result = "garbage"
        note = str(error)
    except BaseException as error:
        kinds = {MemoryError: "memory", Hang: "hang"}
        result = kinds.get(type(error), "escaped")
        note = f"{type(error).__name__}: {str(error)[:200]}{place(error)}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        watch.on = False
    if watch.seen or mark.exists():
        result = "executed"
        note = watch.seen or "the mark is there"
        mark.unlink(missing_ok=True)
    return result, note


def place(error: BaseException) -> str:
    """The last line of the package that an exception passed."""
    lines = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if "e2rl" in Path(frame.filename).parts
    ]
    return f" at {Path(lines[-1].filename).name}:{lines[-1].lineno}" if lines else ""


def _hangs(*_: Any) -> None:
    raise Hang


def child(folder: Path, reader: str, count: int, start: int, data: str | None) -> None:
    """Read inputs; each is written to `folder`/input before, and its outcome is a line
    of standard output."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print
    warnings.filterwarnings("ignore")
    for number in (signal.SIGPROF, signal.SIGALRM):
        signal.signal(number, _hangs)
    os.environ["XDG_CACHE_HOME"] = tempfile.tempdir = str(folder / "temporary")
    Path(tempfile.tempdir).mkdir(exist_ok=True)
    readers = Readers(folder, data)
    inputs, read = getattr(readers, reader)()
    watch = Watch(folder)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.RLIM_INFINITY))

    @seed(start)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=HealthCheck,
    )
    @given(inputs)
    def each(content: bytes) -> None:
        (folder / "input").write_bytes(content)
        print(
            json.dumps(outcome(read, content, watch, readers.mark)),
            file=out,
            flush=True,
        )

    each()


# --- the parent


def rows_of(
    folder: Path, reader: str, options: argparse.Namespace
) -> Iterator[tuple[str, str]]:
    """Outcomes of N inputs of a reader; a child that dies or waits too long costs one
    input."""
    left = options.count
    start = options.seed
    while left > 0:
        command = [
            sys.executable,
            "-m",
            "tools.fuzz",
            str(left),
            reader,
            "--seed",
            str(start),
            "--child",
            str(folder),
        ]
        command += ["--data", options.data] if options.data else []
        begun = left
        with subprocess.Popen(
            ["timeout", str(WAIT + WALL / 20 * left), *command],
            stdout=subprocess.PIPE,
            cwd=ROOT,
        ) as process:
            assert process.stdout is not None
            for line in process.stdout:
                left -= 1
                yield tuple(json.loads(line))
        if process.returncode == 0:  # hypothesis knows no more inputs
            return
        if left == begun:
            raise SystemExit(f"{reader}: the child does not start")
        yield (
            "hang" if process.returncode == 124 else "crash",
            f"status {process.returncode}",
        )
        left = left - 1
        start = start + 1


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("count", type=int, metavar="N")
    parser.add_argument(
        "readers",
        nargs="*",
        metavar="READER",
        default=[],
        help=", ".join(Readers.NAMES),
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--data",
        metavar="LOGS",
        help="folder or zip of scenarios to damage; default: a made one",
    )
    parser.add_argument(
        "--keep",
        type=Path,
        metavar="FOLDER",
        help="for the inputs that were not refused or read",
    )
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.child:
        child(
            options.child, options.readers[0], options.count, options.seed, options.data
        )
        return 0
    bad = 0
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        run = [
            *RUN,
            f"data.cache={folder / 'cache'}",
            f"hydra.run.dir={folder / 'run'}",
        ]
        subprocess.run(
            [sys.executable, "evaluate.py", *run],
            cwd=ROOT,
            check=True,
            capture_output=True,
        )
        for reader in options.readers or Readers.NAMES:
            counts: Counter = Counter()
            for result, note in rows_of(folder, reader, options):
                counts[result] += 1
                if result in GOOD:
                    continue
                bad += 1
                print(f"{reader}: {result}: {note}", file=sys.stderr, flush=True)
                if options.keep:
                    options.keep.mkdir(parents=True, exist_ok=True)
                    (options.keep / f"{reader}-{bad}-{result}").write_bytes(
                        (folder / "input").read_bytes()
                    )
            print(f"{reader}: {counts.total()} inputs, {dict(counts)}")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
