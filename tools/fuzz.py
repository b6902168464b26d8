"""python -m tools.fuzz N [READER ...] [--seed S] [--data LOGS] [--keep FOLDER]: N malformed inputs for each reader.

The readers are those of files and messages that strangers may have written. Their inputs are drawn by hypothesis: whole
ones with bytes or values changed, and what a hostile author might write. Each is read in a child process of limited
memory and time, in which an audit hook notes what runs code. Outcomes:

| refused | by the program's own error, which names the file |
| read | as what the whole input says, or as another plausible value |
| escaped | another exception |
| garbage | read as something that it is not |
| hang, crash, memory | more than LIMIT seconds of the processor; the child died; more than MEMORY bytes |
| executed | code of the input ran, or a process, a connection or a file elsewhere was opened |

The exit status is 1 where any but the first two came out; --keep writes those inputs into a folder.
"""

import argparse
import copy
import hashlib
import io
import json
import os
import pickle
import pickletools
import resource
import signal
import socket
import struct
import subprocess
import sys
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from omegaconf import OmegaConf

from e2rl.evaluation.modes import read_modes
from e2rl.evaluation.rollout_files import read_metrics, read_rows
from e2rl.metrics.score import score_rollouts
from e2rl.planners.ego import PlannerError
from e2rl.planners.external import ExternalEgo, drivable, plans_of
from e2rl.planners.planner_link import ACTION, FAILED, TRAJECTORY, PlannerLink, message
from e2rl.report.tables import metric_tables
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.run.parts import read_state, state_bytes
from e2rl.run.trust import CONFIG, leaves, saved_configuration
from e2rl.scenes.builder import BuildSettings
from e2rl.scenes.scenarionet import ScenarioNetSource, safe_load
from e2rl.scenes.scene_list import read_list
from e2rl.sim.rollouts import Rollouts
from tests.scenes.descriptions import Malicious, description

ROOT = Path(__file__).resolve().parents[1]
LIMIT, WAIT = 10.0, 600.0  # s of the processor for one input; s of the clock for a child, besides a second for each
MEMORY = 1 << 31  # bytes beyond those of the libraries
MOST = 1 << 26  # bytes that a small input may become
SMALL = BuildSettings(steps=20, vehicles=4, others=2, vertices=40, field_cells=32)
GOOD = ("refused", "read")
FORBIDDEN = ("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "pty.spawn")
FORBIDDEN += ("subprocess.Popen", "socket.connect", "socket.bind", "socket.getaddrinfo", "pickle.find_class")
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CELLS = (int, float, bool, str, bytes, bytearray, complex, type(None), np.generic)
RUN = ["data.split=tune", "num_scenes=2", "data.workers=1", "data.build.steps=20", "data.build.vehicles=4"]
RUN += ["data.build.field_cells=64", "ego=idm", "methods=[replay,constant_velocity]", "seeds=[0]", "processes=1"]


class Garbage(Exception):
    """An input was read as something that it is not."""


class Hang(BaseException):
    """An input takes too long."""


def require(true: bool, what: str) -> None:
    if not true:
        raise Garbage(what)


# --- inputs

LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20) | st.just("x" * 300)
PLAIN = st.recursive(
    LEAVES,
    lambda parts: st.lists(parts, max_size=3) | st.dictionaries(st.text(max_size=8), parts, max_size=3),
    max_leaves=5,
)
ARRAYS = arrays.arrays(
    st.sampled_from([np.float64, np.float32, np.int64, np.bool_, np.dtype("U3")]),
    arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)
HOSTILE = st.sampled_from(["os.system", "builtins.exec", "subprocess.Popen", "hydra.utils.call", "${oc.env:HOME}"])


def damaged(content: bytes) -> st.SearchStrategy[bytes]:
    """Copies with one to six places flipped, removed, repeated or cut off."""
    place = st.integers(0, max(len(content) - 1, 0))
    kind = st.sampled_from(["flip", "flip", "flip", "remove", "repeat", "cut"])
    return st.lists(st.tuples(kind, place, st.integers(1, 255)), min_size=1, max_size=6).map(partial(edited, content))


def edited(content: bytes, edits: list[tuple[str, int, int]]) -> bytes:
    changed = bytearray(content)
    for kind, place, number in edits:
        if kind == "flip" and place < len(changed):
            changed[place] ^= number
        elif kind == "remove":
            del changed[place : place + number]
        elif kind == "repeat":
            changed[place:place] = changed[place : place + number]
        elif kind == "cut":
            del changed[place:]
    return bytes(changed)


@st.composite
def mutated(draw: Callable, data: Any, odd: st.SearchStrategy = PLAIN) -> Any:
    """Copies of nested containers with one to three parts removed, replaced, or with one number changed."""
    data = copy.deepcopy(data)
    for _ in range(draw(st.integers(1, 3))):
        place, parent, key = data, None, None
        while isinstance(place, dict | list) and place and (parent is None or draw(st.integers(0, 6))):
            parent, key = place, draw(st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place))))
            place = parent[key]
        if parent is None:
            continue
        numbers = isinstance(place, np.ndarray) and place.ndim and place.size and place.dtype.kind == "f"
        if numbers and draw(st.booleans()):
            changed = place.copy()
            changed.flat[draw(st.integers(0, place.size - 1))] = draw(st.floats())
            parent[key] = draw(st.sampled_from([changed, place[: len(place) // 2], place * 1e3, place[..., None]]))
        elif isinstance(parent, dict) and not draw(st.integers(0, 3)):
            del parent[key]
        else:
            parent[key] = copy.deepcopy(draw(odd))
    return data


def opcodes() -> st.SearchStrategy[bytes]:
    """Programs of random opcodes of pickle with arguments of their kinds."""
    lines = st.sampled_from([b"1\n", b"-7\n", b"1e9\n", b"'x'\n", b"99999999999\n", b"os\nsystem\n", b"numpy\ndtype\n"])
    counted = st.tuples(st.sampled_from([1, 4, 8]), st.binary(max_size=16))
    counted = counted.map(lambda given: len(given[1]).to_bytes(given[0], "little") + given[1])
    one = st.sampled_from(pickletools.opcodes).flatmap(
        lambda code: st.tuples(
            st.just(code.code.encode("latin-1")),
            st.just(b"") if code.arg is None else lines if code.arg.n == -1 else counted | st.binary(max_size=8),
        ).map(b"".join)
    )
    return st.lists(one, min_size=2, max_size=40).map(lambda parts: b"\x80\x04" + b"".join(parts) + b".")


def hostile(mark: str) -> st.SearchStrategy[bytes]:
    """Pickles that run code, claim terabytes, nest deep, or are random programs; code would write the file `mark`."""
    code, laugh = f"open({mark!r}, 'w').close()", []
    for _ in range(60):
        laugh = [laugh, laugh]
    calls = [(exec, code), (os.system, f"touch {mark}"), (subprocess.check_call, ["touch", mark])]
    calls += [(open, mark, "w"), (np.load, mark), (bytearray, 1 << 40), (np.zeros, (1 << 40,))]
    parts = [Malicious(*call) for call in calls]
    parts += [held for call in parts for held in ({"tracks": call}, {"a": [call, 1]})]
    running = [pickle.dumps(part, protocol) for part in parts for protocol in (0, 2, 4)]
    claiming = [b"\x80\x05" + name + b"\xff" * width + b"x" * 20 + b"." for name, width in ((b"\x8e", 8), (b"B", 4))]
    nesting = [b"]" + b"\x85" * 200_000 + b".", b"(" * 200_000 + b"t" * 200_000 + b".", b"]q\x00h\x00a."]
    return st.sampled_from([*running, *claiming, *nesting, pickle.dumps(laugh)]) | opcodes()


# --- readers: a strategy of bytes, and what reads them in the folder of a file

Reader = tuple[st.SearchStrategy[bytes], Callable[[bytes], Any]]


class Readers:
    """The readers by name, with inputs made of a finished run in `folder`/run."""

    NAMES = ("pickles", "descriptions", "tables", "rollouts", "parts", "configurations", "planner_replies")

    def __init__(self, folder: Path, data: str | None) -> None:
        self.folder, self.mark, self.data = folder, folder / "mark", [description()]
        if data:
            source = ScenarioNetSource(data)
            self.data = [safe_load(source.content(log), log) for log in source.logs()[:8]]

    def file(self, name: str, content: bytes) -> Path:
        path = self.folder / "inputs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return path

    def pickles(self) -> Reader:
        whole = [pickle.dumps(scene, protocol) for scene in self.data[:3] for protocol in (0, 2, 4)]
        inputs = st.sampled_from(whole).flatmap(damaged) | hostile(str(self.mark))
        return inputs, lambda content: require_plain(safe_load(content, "input"), 40 * MOST)

    def descriptions(self) -> Reader:
        def read(content: bytes) -> None:
            logs, cache = self.file("logs/input.pkl", content).parent, self.folder / "scenes"
            scenes = ScenarioNetSource(str(logs), build=SMALL, workers=1, cache=str(cache)).load()
            for name, value in scenes.scenes.items():
                require(not value.is_floating_point() or bool(value.isfinite().all()), f"{name} is not finite")

        return st.sampled_from(self.data).flatmap(lambda data: mutated(data, PLAIN | ARRAYS)).map(pickle.dumps), read

    def tables(self) -> Reader:
        """The tables of a run: metrics, failure modes, rollouts, scenes."""
        run = self.folder / "run"
        readers = {"metrics.json": lambda path: metric_tables(read_metrics(path)), "modes.json": read_modes}
        readers |= {"rollouts.csv": read_rows, "scenes.csv": read_list}

        def inputs(name: str) -> st.SearchStrategy[bytes]:
            content = (run / name).read_bytes()
            found = damaged(content)
            if name.endswith(".json"):
                found |= mutated(json.loads(content)).map(json.dumps).map(str.encode)
            return found.map(lambda content: name.encode() + b"\n" + content)

        def read(content: bytes) -> None:
            name, _, rest = content.partition(b"\n")
            readers[name.decode()](self.file(name.decode(), rest))

        return st.sampled_from(sorted(readers)).flatmap(inputs), read

    def rollouts(self) -> Reader:
        path = sorted((self.folder / "run" / "rollouts").glob("*.npz"))[0]
        with np.load(path) as whole:
            data = dict(whole)

        def stored(values: dict) -> bytes:
            buffer = io.BytesIO()
            np.savez(buffer, **{name: np.asarray(value) for name, value in values.items()})
            return buffer.getvalue()

        def read(content: bytes) -> None:
            rollouts = Rollouts.from_npz(self.file("input.npz", content))
            known, driven = rollouts.valid, rollouts.states[rollouts.valid]
            require(known.shape == rollouts.states.shape[:3], "states of other agents")
            require(bool(driven.isfinite().all() and (driven.abs() < 200_000).all()), "no place or speed")
            score_rollouts(rollouts)

        return damaged(path.read_bytes()) | mutated(data, ARRAYS | st.floats() | st.text(max_size=9)).map(stored), read

    def parts(self) -> Reader:
        """Finished parts and checkpoints: torch's format after a hash, which a stranger can make anew."""
        value = [{"scene_id": "a", "cfr": 0.5, "seed": 1}, [torch.arange(5.0), torch.zeros(3, 2)]]
        whole = state_bytes(value)
        begin = len(whole) - len(content) if (content := whole[whole.index(b"PK") :]) else 0

        def other(program: bytes) -> bytes:
            result = io.BytesIO()
            with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(result, "w") as new:
                for name in old.namelist():
                    new.writestr(name, program if name.endswith("data.pkl") else old.read(name))
            return whole[: begin - 32] + hashlib.sha256(result.getvalue()).digest() + result.getvalue()

        def read(content: bytes) -> None:
            try:
                read_state(self.file("part.pt", content))
            except ValueError as error:  # the part is done again
                raise InputError(str(error)) from error

        return damaged(whole) | hostile(str(self.mark)).map(other), read

    def configurations(self) -> Reader:
        """The configuration of a run that is resumed: none may name code outside of e2rl."""
        whole = (self.folder / "run" / CONFIG).read_bytes()
        plain = OmegaConf.to_container(OmegaConf.create(whole.decode()))
        given, folder = load_config("evaluate", ["resume=input"]), self.folder / "inputs" / "resumed"

        def read(content: bytes) -> None:
            self.file(f"resumed/{CONFIG}", content)
            saved = OmegaConf.to_container(saved_configuration(given, folder, "resume=input"))
            named = [(key, str(value)) for key, value in leaves(saved)]
            code = [value for key, value in named if "_target_" in key and not value.startswith("e2rl.")]
            code += [value for _, value in named if "${" in value and ":" in value]
            require(not code, f"it names {code[:1]}")

        starts = st.just({"_target_": "e2rl.planners.external.ExternalEgo", "command": f"touch {self.mark}"})
        changed = mutated(plain, PLAIN | HOSTILE | starts).map(lambda data: OmegaConf.to_yaml(OmegaConf.create(data)))
        return damaged(whole) | changed.map(str.encode), read

    def planner_replies(self) -> Reader:
        """Bytes that an outside planner answers with."""
        odd = st.sampled_from([0.0, 1e9, float("nan"), -3.0, float("inf"), 0.5])
        rows = st.sampled_from([0, 1, 2, 7]).map(partial(struct.pack, "<I"))
        action = st.tuples(rows, odd).map(lambda g: message(ACTION, g[0] + struct.pack("<2f", g[1], 0.1)))
        failed = rows.map(lambda row: message(FAILED, row + b"lost \xff"))
        plan = st.tuples(rows, st.sampled_from([50, 5, 4, 0]), st.sampled_from([0, 2**31]), odd).map(
            lambda g: message(
                TRAJECTORY, g[0] + struct.pack("<I", g[1] or g[2]) + g[1] * struct.pack("<4f", 0.1, g[3], 0.0, 1.0)
            )
        )
        replies = st.lists(action | plan | failed, min_size=1, max_size=4).map(b"".join)
        now = torch.tensor([[0.0, 0.0, 0.3, 8.0], [5.0, 1.0, -2.0, 0.0], [9.0, 9.0, 0.0, 20.0]])

        def read(content: bytes) -> None:
            ours, theirs = socket.socketpair()
            link = PlannerLink.__new__(PlannerLink)
            link._buffer, link._socket, link._process, link._name = bytearray(), ours, None, "input"
            link.close = ours.close  # type: ignore[method-assign]
            ego = ExternalEgo(command="true", timeout=0.05)
            ego._link = link
            with ours, theirs:
                theirs.sendall(content)
                theirs.shutdown(socket.SHUT_WR)
                try:
                    plans = plans_of(now, ego._ask(b"x", len(now)), 5)
                except PlannerError as error:
                    require(all(0 <= row < len(now) for row in error.rows), "a scene that was not asked for")
                    raise InputError(str(error)) from error
            whole = torch.full((len(now),), plans.shape[1])
            require(bool(drivable(now, plans, whole).all()), "a plan that no vehicle drives")

        return replies | replies.flatmap(damaged), read


def require_plain(data: Any, most: int) -> None:
    """Garbage where data hold anything but containers, numbers, text and arrays, or are larger than `most` bytes."""
    size, waiting, seen = 0, [data], set()
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            size += value.nbytes
            waiting += list(value.flat) if value.dtype.kind == "O" else []
        elif isinstance(value, dict | list | tuple | set | frozenset):
            waiting += [*value, *value.values()] if isinstance(value, dict) else value
        else:
            require(isinstance(value, CELLS), f"a {type(value).__name__}")
            size += len(value) if isinstance(value, str | bytes) else 8
        require(size <= most, "more than its bytes can say")


# --- the child, which reads


class Watch:
    """Notes what code that runs in an input would do; inputs are written below `folder`."""

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


def outcome(read: Callable[[bytes], Any], content: bytes, watch: Watch, mark: Path) -> tuple[str, str]:
    """What came of one input, and a note on what is bad."""
    result, note, watch.seen, watch.on = "read", "", "", True
    try:
        signal.setitimer(signal.ITIMER_PROF, LIMIT)
        read(content)
    except InputError as error:
        result, note = ("refused", "") if str(error) else ("escaped", "an InputError without a word")
    except Garbage as error:
        result, note = "garbage", str(error)
    except BaseException as error:
        kinds = {MemoryError: "memory", Hang: "hang"}
        result, note = kinds.get(type(error), "escaped"), f"{type(error).__name__}: {str(error)[:200]}{place(error)}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        watch.on = False
    if watch.seen or mark.exists():
        result, note = "executed", watch.seen or "the mark is there"
        mark.unlink(missing_ok=True)
    return result, note


def place(error: BaseException) -> str:
    """The last line of the package that an exception passed."""
    lines = [frame for frame in traceback.extract_tb(error.__traceback__) if "e2rl" in Path(frame.filename).parts]
    return f" at {Path(lines[-1].filename).name}:{lines[-1].lineno}" if lines else ""


def _hangs(*_: Any) -> None:
    raise Hang


def child(folder: Path, reader: str, count: int, start: int, data: str | None) -> None:
    """Read inputs; each is written to `folder`/input before, and its outcome is a line of standard output."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print
    warnings.filterwarnings("ignore")
    signal.signal(signal.SIGPROF, _hangs)
    readers = Readers(folder, data)
    inputs, read = getattr(readers, reader)()
    watch = Watch(folder)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.RLIM_INFINITY))

    @seed(start)
    @settings(
        max_examples=count, database=None, deadline=None, phases=[Phase.generate], suppress_health_check=HealthCheck
    )
    @given(inputs)
    def each(content: bytes) -> None:
        (folder / "input").write_bytes(content)
        print(json.dumps(outcome(read, content, watch, readers.mark)), file=out, flush=True)

    each()


# --- the parent


def rows_of(folder: Path, reader: str, options: argparse.Namespace) -> Iterator[tuple[str, str]]:
    """Outcomes of N inputs of a reader; a child that dies or waits too long costs one input."""
    left, start = options.count, options.seed
    while left > 0:
        command = [sys.executable, "-m", "tools.fuzz", str(left), reader, "--seed", str(start), "--child", str(folder)]
        command += ["--data", options.data] if options.data else []
        begun = left
        with subprocess.Popen(["timeout", str(WAIT + left), *command], stdout=subprocess.PIPE, cwd=ROOT) as process:
            assert process.stdout is not None
            for line in process.stdout:
                left -= 1
                yield tuple(json.loads(line))
        if process.returncode == 0:  # hypothesis knows no more inputs
            return
        if left == begun:
            raise SystemExit(f"{reader}: the child does not start")
        yield "hang" if process.returncode == 124 else "crash", f"status {process.returncode}"
        left, start = left - 1, start + 1


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, metavar="N")
    parser.add_argument("readers", nargs="*", metavar="READER", default=[], help=", ".join(Readers.NAMES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", metavar="LOGS", help="folder or zip of scenarios to damage; default: a made one")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for the inputs that were not refused or read")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.child:
        child(options.child, options.readers[0], options.count, options.seed, options.data)
        return 0
    bad = 0
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        run = [*RUN, f"data.cache={folder / 'cache'}", f"hydra.run.dir={folder / 'run'}"]
        subprocess.run([sys.executable, "evaluate.py", *run], cwd=ROOT, check=True, capture_output=True)
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
                    (options.keep / f"{reader}-{bad}-{result}").write_bytes((folder / "input").read_bytes())
            print(f"{reader}: {counts.total()} inputs, {dict(counts)}")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
