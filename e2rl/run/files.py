"""Files that appear whole or not at all, and whose later changes are detected."""

import csv
import errno
import fcntl
import hashlib
import io
import json
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np

from e2rl.run.errors import InputError

MAX_FILE = 1 << 30  # bytes of a file of a run
MAX_RECORD = 1 << 22  # bytes of plain values that a command writes about a run
MAX_HASHED = 1 << 36  # bytes of a file whose content is not held, weights
MAX_ARRAYS = 1 << 30  # bytes of one npz, unpacked
WAIT = 5  # s that another run's workers have to end
LOGGER = "wandb"
SEAL = "sha256.json"  # of a sealed folder: {file: hash}
STREAMS = {"/dev/stdout": 1, "/dev/stderr": 2}
# what a spreadsheet may run; full-width too
FORMULA = re.compile(r"'*(\s*[=+\-@\uff1d\uff0b\uff0d\uff20]|[\t\r\n])")
NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
# +2.1 [+0.4, +3.9]* (12)
ESTIMATE = re.compile(rf"{NUMBER}(?: \[{NUMBER}, {NUMBER}\])?\*?(?: \(\d+\))?")
DAMAGED = (
    OSError,
    EOFError,
    LookupError,
    TypeError,
    ValueError,
    RuntimeError,
    MemoryError,
    SyntaxError,
    zipfile.BadZipFile,
    zlib.error,
)
Content = bytes | str | Callable[[Path], object]  # or what writes it to a path


def cache_folder() -> Path:
    """Returns the folder of caches of this user: that of XDG_CACHE_HOME, or ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "e2rl"


# --- reading what may be a stranger's


def open_regular(
    path: Path,
    limit: int = MAX_FILE,
    within: Path | None = None,
) -> io.BufferedReader:
    """Open a regular file to read, which never blocks.

    Args:
        path: of the file.
        limit: bytes that it has at most.
        within: folder in which it lies once links are followed, as the files of a run
            do.

    Raises:
        OSError: where it is missing, a folder, a pipe, a device, larger, or a link to
            somewhere else.
    """
    if within is not None and not leads_into(path, within):
        raise OSError(errno.EPERM, f"a link out of {within}", str(path))
    file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    status = os.fstat(file.fileno())
    if not stat.S_ISREG(status.st_mode):
        file.close()
        raise OSError(errno.EINVAL, "no regular file", str(path))
    if status.st_size > limit:
        file.close()
        raise OSError(errno.EFBIG, f"larger than {limit / 1e6:.3g} MB", str(path))
    return file


def read_regular(
    path: Path,
    limit: int = MAX_FILE,
    within: Path | None = None,
) -> bytes:
    """Returns the bytes of a file as `open_regular` opens it; raises as it does."""
    with open_regular(path, limit, within=within) as file:
        return file.read()


def check_format(
    where: Path | str, written: object, *, expected: str, mend: str
) -> None:
    """Raises InputError where a file is of another format than the one that is read.

    Args:
        where: the file, or the option that names it.
        written: format that the file says it has; None: it says nothing.
        expected: format that is read.
        mend: what to do about it.
    """
    if written != expected:
        has = "of no format" if written is None else f"of format {str(written)[:40]}"
        raise InputError(
            f"{where}: {has}, e2rl {version('e2rl')} reads {expected}; {mend}"
        )


def leads_into(path: Path, folder: Path) -> bool:
    """Returns whether a path lies in a folder once links are followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def check_folder(folder: Path) -> None:
    """Raises InputError where a run's folder, which may be a stranger's, holds a link
    out of it, a pipe or a device.

    The folder of LOGGER is left out, which links to its own logs: nothing is read
    there.
    """
    for place, folders, names in os.walk(folder):
        for path in (Path(place, name) for name in (*folders, *names)):
            if path.is_symlink():
                if not leads_into(path, folder):
                    raise InputError(
                        f"{path}: a link out of the run's folder; put there what it "
                        "leads to"
                    )
            elif not path.is_dir() and not path.is_file():
                raise InputError(f"{path}: no regular file; remove it")
        if Path(place) == folder and LOGGER in folders:
            folders.remove(LOGGER)


def read_arrays(
    file: Path | IO[bytes], most: int = MAX_ARRAYS
) -> dict[str, np.ndarray]:
    """Returns the arrays of an npz, none of them pickled; ValueError where it is
    damaged or claims more than `most` bytes."""
    if isinstance(file, Path) and not file.is_file():
        raise ValueError("no regular file")
    try:
        with zipfile.ZipFile(file) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > most:
            raise ValueError(
                f"unpacks to {size / 1e6:.0f} MB, more than {most / 1e6:.0f}"
            )
        with np.load(file, allow_pickle=False) as archive:
            arrays = {key: np.asarray(archive[key]) for key in archive.files}
    except DAMAGED as error:
        reason = str(error) or type(error).__name__
        raise ValueError(reason.splitlines()[0]) from error
    for key, array in arrays.items():
        if array.dtype.kind == "b" and array.shape:
            arrays[key] = array.view(np.uint8) != 0  # numpy counts on bytes 0 and 1
    return arrays


def misfit(value: Any, shape: Any, where: str = "it") -> str | None:
    """Returns what in plain nested containers, as of JSON, has another shape than it
    must; None: nothing.

    shape: a type or several; [shape] for a list of any length; {name: shape} for a dict
    with these keys and others; a shape under the name ... is that of every other key.
    """
    parts: list[tuple[str, Any, Any]] = []
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            return f"{where} is no object"
        for name in shape:
            if name is not ... and name not in value:
                return f"{where}.{name} is missing"
        for name, part in value.items():
            if name in shape or ... in shape:
                part_shape = shape[name if name in shape else ...]
                parts.append((f"{where}.{name}", part, part_shape))
    elif isinstance(shape, list):
        if not isinstance(value, list):
            return f"{where} is no list"
        for index, part in enumerate(value):
            parts.append((f"{where}[{index}]", part, shape[0]))
    elif not isinstance(value, shape):
        return f"{where} is {str(value)[:40]!r}"
    for place, part, part_shape in parts:
        if reason := misfit(part, part_shape, where=place):
            return reason
    return None


# --- CSV


def csv_text(rows: Iterable[Iterable]) -> str:
    """Returns rows of values as CSV, for `CsvReader`.

    A spreadsheet runs a text that begins as a formula does. Names come from strangers'
    data, so such a text begins with an apostrophe instead. Numbers stay as they are.
    """
    lines: list[str] = []
    ending = "\r\n"  # so that cells with either are quoted
    writer = csv.writer(SimpleNamespace(write=lines.append), lineterminator=ending)
    for row in rows:
        writer.writerow(
            [escaped_cell(value) if isinstance(value, str) else value for value in row]
        )
    return "".join(f"{line.removesuffix(ending)}\n" for line in lines)


def escaped_cell(text: str) -> str:
    """Returns the text as a cell that no spreadsheet runs; `plain_cell` gives the text
    back."""
    return f"'{text}" if FORMULA.match(text) and not ESTIMATE.fullmatch(text) else text


def plain_cell(text: Any) -> Any:
    """Returns the text of a cell of `escaped_cell`; anything else as it is."""
    if isinstance(text, str) and text.startswith("'") and FORMULA.match(text):
        return text[1:]
    return text


class CsvReader(csv.DictReader):
    """The rows of a CSV file that `csv_text` wrote, by their heads; csv.Error where it
    is damaged."""

    def __init__(self, lines: Iterable[str]) -> None:
        super().__init__(lines, strict=True)

    @property
    def fieldnames(self) -> list[str] | None:  # type: ignore[override]
        names = super().fieldnames
        return None if names is None else list(map(plain_cell, names))

    def __next__(self) -> dict[str, Any]:
        return {key: plain_cell(value) for key, value in super().__next__().items()}


# --- writing


def write_atomically(path: Path, content: Content) -> None:
    """Write a file under a temporary name beside it, then rename it, so that no reader
    meets half a file.

    A link is followed: what it leads to is replaced. A device, a pipe and STREAMS are
    written through. Missing parent folders are made.

    Args:
        path: of the file.
        content: the bytes or text of the file, or a function that writes the file whose
            path it is given.

    Raises:
        OSError: where it cannot be written, a folder, a socket and a read-only file
            among them. It names `path`, and nothing is left behind.
    """
    path = Path(path)
    try:
        if is_stream(path):
            _write_through(path, content)
        else:
            _replace(Path(os.path.realpath(path)), content)
    except OSError as error:
        if error.errno is not None:
            error.filename = str(path)
        raise


def is_stream(path: Path) -> bool:
    """Returns whether a path is a device, a pipe or one of STREAMS, beside which
    nothing is written. Raises OSError for a folder, a socket, a disk, and a loop of
    links."""
    if str(path) in STREAMS:
        return True
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return False
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if stat.S_ISSOCK(mode) or stat.S_ISBLK(mode):
        raise PermissionError(errno.EPERM, "a socket or a disk, not a file", str(path))
    return not stat.S_ISREG(mode)


def _write_through(path: Path, content: Content) -> None:
    """Write into a stream, after what this process has printed."""
    if callable(content):
        with tempfile.TemporaryDirectory() as folder:
            part = Path(folder, "content")
            content(part)
            content = part.read_bytes()
    for stream in filter(None, (sys.stdout, sys.stderr)):
        stream.flush()
    number = STREAMS.get(str(path))
    handle = os.open(path, os.O_WRONLY) if number is None else os.dup(number)
    with open(handle, "wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)


def _replace(path: Path, content: Content) -> None:
    """Write a regular file, which keeps its permissions, or a new one."""
    mode = None
    if path.exists():
        mode = stat.S_IMODE(path.stat().st_mode)
        writable = mode & (stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH)
        if not writable or not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, "read-only", str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    part = _part_beside(path)
    part.touch(exist_ok=False)
    try:
        if mode is None:
            mode = stat.S_IMODE(part.stat().st_mode)  # as the umask has it
        if callable(content):
            content(part)
        else:
            part.write_bytes(content.encode() if isinstance(content, str) else content)
        part.chmod(mode)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def _part_beside(path: Path) -> Path:
    """A name beside a path, of which there is none yet, for what it will be."""
    return path.with_name(f".{secrets.token_hex(8)}.part")


def write_beside(path: Path, suffix: str, content: Content) -> None:
    """Write a file of the name of `path` with another suffix; nothing where `path` is a
    stream. Raises OSError where it cannot be written, and for a link out of its folder,
    which nobody has named."""
    if is_stream(path):
        return
    beside = path.with_suffix(suffix)
    if not leads_into(beside, beside.parent):
        raise PermissionError(errno.EPERM, "a link out of its folder", str(beside))
    write_atomically(beside, content)


@contextmanager
def written_whole(folder: Path) -> Iterator[Path]:
    """Gives an empty folder under a temporary name beside `folder`, renamed to it where
    the block ends well, else removed."""
    folder = Path(os.path.realpath(folder))
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = _part_beside(folder)
    part.mkdir()
    try:
        yield part
        part.rename(folder)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


# --- hashes


def sha256_of(path: Path, within: Path | None = None) -> str:
    """Returns the SHA-256 of a file's content, in hex; raises OSError as `open_regular`
    does."""
    with open_regular(path, MAX_HASHED, within=within) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_files(paths: Iterable[Path]) -> bytes:
    """Returns the SHA-256 of the names and contents of files, for `Source.fingerprint`;
    of a pipe or a link to nothing of its name. Raises InputError for a file that cannot
    be read."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(os.fsencode(path.name))
        if not path.is_file():
            continue
        try:
            with open_regular(path, sys.maxsize) as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise InputError(
                f"{path}: cannot be read: {error.strerror}; make it readable, or "
                "remove it"
            ) from error
    return digest.digest()


def seal(folder: Path) -> None:
    """Write the hashes of a folder's files into it, for `altered`."""
    paths = sorted(path for path in folder.iterdir() if path.name != SEAL)
    hashes = {path.name: sha256_of(path) for path in paths}
    write_atomically(folder / SEAL, json.dumps(hashes, indent=1))


def altered(folder: Path) -> str | None:
    """Returns the name of the first file of a sealed folder that is not what was
    written; None: all are."""
    try:
        hashes = json.loads(read_regular(folder / SEAL, MAX_RECORD, within=folder))
        for name, written in hashes.items():
            if sha256_of(folder / name, folder) != written:
                return name
    except FileNotFoundError as error:
        return Path(error.filename).name
    except (OSError, ValueError, AttributeError, RecursionError):
        return SEAL
    return None


# --- locks


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of `path` among processes: others wait at the beginning of their
    block."""
    name = path.with_name(f".{path.name}.lock")
    while True:
        handle = os.open(name, os.O_RDWR | os.O_CREAT, 0o644)
        fcntl.flock(handle, fcntl.LOCK_EX)
        try:
            if os.path.samestat(os.stat(name), os.fstat(handle)):
                break
        except FileNotFoundError:  # its last holder has removed it in the meantime
            pass
        os.close(handle)
    try:
        yield
    finally:
        name.unlink(missing_ok=True)
        os.close(handle)


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Hold a run's folder for this process alone; raises InputError where another
    process is at work there."""
    handle = os.open(folder, os.O_RDONLY)
    deadline = time.monotonic() + WAIT
    try:
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise InputError(
                        f"{folder}: another process is at work in this run; wait for "
                        "it, or end it"
                    ) from None
                # workers of a process that was killed end soon, but not at once
                time.sleep(1.0)
        yield
    finally:
        os.close(handle)
