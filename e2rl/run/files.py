"""Files that appear whole or not at all, and whose later changes are detected.

Weights in safetensors files, with a hash of what was written in the header: an altered
file is noticed.

Files of earlier versions have no hash; of those only the form is checked.
"""

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
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from e2rl.run.errors import InputError

MAX_FILE = 1 << 30  # bytes of a file of a run
MAX_RECORD = (
    1 << 22
)  # bytes of a file of plain values that a command writes about a run
MAX_HASHED = 1 << 36  # bytes of a file whose content is not held, weights
MAX_ARRAYS = 1 << 30  # bytes of one npz, unpacked
WAIT = 5  # s that another run's workers have to end
LOGGER = "wandb"
HASH = "sha256"  # key in the header of a file of weights
SEAL = "sha256.json"  # of a sealed folder: {file: hash}
LONG_NAME, SHORT_NAME = (
    230,
    50,
)  # bytes of a name that leave room for more; characters of a longer one that are kept
ANY_WRITE = 0o222  # permissions to write
MOST_LINKS = 40  # that lead to one file, as on Linux
DESCRIPTOR = re.compile(
    r"/(?:dev|proc/(?P<process>\d+)(?:/task/\d+)?)/fd/(?P<number>\d+)"
)
FORMULA = re.compile(
    r"'*(\s*[=+\-@\uff1d\uff0b\uff0d\uff20]|[\t\r\n])"
)  # what a spreadsheet may run; full-width too
NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
ESTIMATE = re.compile(
    rf"{NUMBER}(?: \[{NUMBER}, {NUMBER}\])?\*?(?: \(\d+\))?"
)  # +2.1 [+0.4, +3.9]* (12)
DAMAGED = (
    OSError,
    EOFError,
    LookupError,
    TypeError,
    ValueError,
    RuntimeError,
    MemoryError,
    SyntaxError,
)


def cache_folder() -> Path:
    """Returns the folder of caches of this user: that of XDG_CACHE_HOME, or ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "e2rl"


def open_regular(
    path: Path, limit: int = MAX_FILE, within: Path | None = None
) -> io.BufferedReader:
    """Open a regular file to read, which never blocks.

    Args:
        limit: bytes that it has at most.
        within: folder in which it lies once links are followed, as the files of a run
            do.

    Raises:
        OSError: where it is missing, a folder, a pipe, a device, larger, or a link to
            somewhere else.
    """
    if within is not None and not leads_into(path, within):
        raise OSError(errno.EPERM, f"a link out of {within}", str(path))
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "no regular file", str(path))
        if found.st_size > limit:
            raise OSError(errno.EFBIG, f"larger than {limit / 1e6:.3g} MB", str(path))
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_regular(
    path: Path, limit: int = MAX_FILE, within: Path | None = None
) -> bytes:
    """Returns the bytes of a file as `open_regular` opens it; raises as it does."""
    with open_regular(path, limit, within=within) as file:
        return file.read()


def check_folder(folder: Path) -> None:
    """Raises InputError where a run's folder, which may be a stranger's, holds a link
    out of it, a pipe or a device.

    The folder of LOGGER is left out, which links to its own logs: nothing is read
    there.
    """
    for place, folders, files in os.walk(folder):
        for path in (Path(place, name) for name in (*folders, *files)):
            if path.is_symlink() and not leads_into(path, folder):
                raise InputError(
                    f"{path}: a link out of the run's folder; put there what it leads to"
                )
            if not (path.is_symlink() or path.is_dir() or path.is_file()):
                raise InputError(f"{path}: no regular file; remove it")
        folders[:] = [name for name in folders if Path(place, name) != folder / LOGGER]


def leads_into(path: Path, folder: Path) -> bool:
    """Whether a path lies in a folder once links are followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def csv_text(rows: Iterable[Iterable]) -> str:
    """Returns rows of values as CSV, for `CsvReader`.

    A spreadsheet runs a text that begins as a formula does. Names come from strangers'
    data, so such a text begins with an apostrophe instead. Numbers stay as they are.
    """
    lines: list[str] = []
    ending = "\r\n"  # so that cells with either are quoted
    writer = csv.writer(SimpleNamespace(write=lines.append), lineterminator=ending)
    writer.writerows(
        [escaped_cell(value) if isinstance(value, str) else value for value in row]
        for row in rows
    )
    return "".join(f"{line.removesuffix(ending)}\n" for line in lines)


def escaped_cell(text: str) -> str:
    """Returns the text as a cell that no spreadsheet runs; `plain_cell` gives the text
    back."""
    return f"'{text}" if FORMULA.match(text) and not ESTIMATE.fullmatch(text) else text


def plain_cell(text: str) -> str:
    """Returns the text of a cell of `escaped_cell`."""
    return text[1:] if text.startswith("'") and FORMULA.match(text) else text


class CsvReader(csv.DictReader):
    """The rows of a CSV file that `csv_text` wrote, by their heads; csv.Error where it
    is damaged."""

    def __init__(self, lines: Iterable[str]) -> None:
        super().__init__(lines, strict=True)

    @property
    def fieldnames(self) -> list[str] | None:  # type: ignore[override]
        names = super().fieldnames
        return None if names is None else [plain_cell(name) for name in names]

    def __next__(self) -> dict[str, Any]:
        row = super().__next__()
        return {
            key: plain_cell(value) if isinstance(value, str) else value
            for key, value in row.items()
        }


def write_atomically(
    path: Path, content: bytes | str | Callable[[Path], object]
) -> None:
    """Write a file under a temporary name beside it, then rename it, so that no reader
    meets half a file.

    A link is followed: what it leads to is replaced. A device, a pipe and an open file
    of this process (/dev/stdout) are written through. Missing parent folders are made.

    Args:
        content: the bytes or text of the file, or a function that writes the file whose
            path it is given.

    Raises:
        OSError: where it cannot be written, a folder, a socket and a read-only file
            among them. It names `path`, and
            nothing is left behind.
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
    """Returns whether a path is a device, a pipe or an open file of this process,
    beside which nothing is written.

    Raises:
        OSError: for a folder, a socket, a disk, and a loop of links.
    """
    if descriptor_of(path) is not None:
        return True
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return False
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if stat.S_ISSOCK(mode) or stat.S_ISBLK(mode):
        kind = "a socket" if stat.S_ISSOCK(mode) else "a disk"
        raise PermissionError(errno.EPERM, f"{kind}, not a file", str(path))
    return not stat.S_ISREG(mode)


def descriptor_of(path: Path) -> int | None:
    """Returns the number of the open file of this process that a path such as
    /dev/stdout names; None: it names none.

    Where that is a file, it is not to be replaced, since more follows in it.
    """
    folder, name = os.path.split(os.path.abspath(path))
    for _ in range(MOST_LINKS):
        folder = os.path.realpath(folder)
        place = os.path.join(folder, name)
        opened = DESCRIPTOR.fullmatch(place)
        if opened and opened["process"] in (None, str(os.getpid())):
            return int(opened["number"])
        if not os.path.islink(place):
            return None
        folder, name = os.path.split(os.path.join(folder, os.readlink(place)))
    return None


def _write_through(path: Path, content: bytes | str | Callable[[Path], object]) -> None:
    """Write into a stream, after what this process has printed."""
    if callable(content):
        with tempfile.TemporaryDirectory() as folder:
            part = Path(folder, "content")
            content(part)
            content = part.read_bytes()
    for stream in filter(None, (sys.stdout, sys.stderr)):
        stream.flush()
    number = descriptor_of(path)
    with open(
        os.open(path, os.O_WRONLY) if number is None else os.dup(number), "wb"
    ) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def _replace(path: Path, content: bytes | str | Callable[[Path], object]) -> None:
    """Write a regular file, which keeps its permissions, or a new one."""
    mode = stat.S_IMODE(path.stat().st_mode) if path.exists() else None
    if mode is not None and not (mode & ANY_WRITE and os.access(path, os.W_OK)):
        raise PermissionError(errno.EACCES, "read-only", str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    part = _part_of(path)
    handle = os.open(
        part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666 if mode is None else 0o600
    )
    if mode is None:
        mode = stat.S_IMODE(os.fstat(handle).st_mode)  # as the umask has it
    os.close(handle)
    try:
        if callable(content):
            content(part)
        else:
            part.write_bytes(content.encode() if isinstance(content, str) else content)
        part.chmod(mode)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def _part_of(path: Path) -> Path:
    """Returns a name beside a path, of which there is none yet, for what it will be."""
    name = (
        path.name
        if len(os.fsencode(path.name)) <= LONG_NAME
        else path.name[:SHORT_NAME]
    )
    return path.with_name(f".{name}.{secrets.token_hex(8)}.part")


def write_beside(
    path: Path, suffix: str, content: bytes | str | Callable[[Path], object]
) -> None:
    """Write a file of the name of `path` with another suffix; nothing where `path` is a
    stream.

    Raises:
        OSError: where it cannot be written, and for a link out of its folder, which
            nobody has named.
    """
    if is_stream(path):
        return
    beside = path.with_suffix(suffix)
    if not leads_into(beside, beside.parent):
        raise PermissionError(errno.EPERM, "a link out of its folder", str(beside))
    write_atomically(beside, content)


@contextmanager
def written_whole(folder: Path) -> Iterator[Path]:
    """An empty folder under a temporary name beside `folder`, renamed to it where the
    block ends well, else removed."""
    folder = Path(os.path.realpath(folder))
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = _part_of(folder)
    part.mkdir()
    try:
        yield part
        part.rename(folder)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def seal(folder: Path) -> None:
    """Write the hashes of a folder's files into it, for `altered`."""
    hashes = {
        path.name: sha256_of(path)
        for path in sorted(folder.iterdir())
        if path.name != SEAL
    }
    write_atomically(folder / SEAL, json.dumps(hashes, indent=1))


def altered(folder: Path) -> str | None:
    """The name of the first file of a sealed folder that is not what was written; None:
    all are."""
    try:
        hashes = json.loads(read_regular(folder / SEAL, MAX_RECORD, within=folder))
        return next(
            (
                name
                for name, known in hashes.items()
                if sha256_of(folder / name, folder) != known
            ),
            None,
        )
    except FileNotFoundError as error:
        return Path(error.filename).name
    except (OSError, ValueError, AttributeError, RecursionError):
        return SEAL


def sha256_of(path: Path, within: Path | None = None) -> str:
    """SHA-256 of a file's content, in hex; raises OSError as `open_regular` does."""
    with open_regular(path, MAX_HASHED, within=within) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_files(paths: Iterable[Path]) -> bytes:
    """SHA-256 of the names and contents of files, for `Source.fingerprint`; of a pipe
    or a link to nothing of its name.

    Raises InputError for a file that cannot be read.
    """
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
                f"{path}: cannot be read: {error.strerror}; make it readable, or remove it"
            ) from error
    return digest.digest()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of `path` among processes: others wait at the beginning of their
    block."""
    name = path.with_name(f".{path.name}.lock")
    while True:
        handle = os.open(name, os.O_RDWR | os.O_CREAT, 0o644)
        fcntl.flock(handle, fcntl.LOCK_EX)
        try:
            if os.stat(name).st_ino == os.fstat(handle).st_ino:
                break  # else its last holder has removed it in the meantime
        except FileNotFoundError:
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
    try:
        for remaining in reversed(range(WAIT)):
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if not remaining:
                    raise InputError(
                        f"{folder}: another process is at work in this run; wait for it, or end it"
                    ) from None
                time.sleep(
                    1.0
                )  # workers of a process that was killed end soon, but not at once
        yield
    finally:
        os.close(handle)


def read_arrays(
    file: Path | IO[bytes], most: int = MAX_ARRAYS
) -> dict[str, np.ndarray]:
    """The arrays of an npz, none of them pickled; ValueError where it is damaged or
    claims more than `most` bytes."""
    if isinstance(file, Path) and not file.is_file():
        raise ValueError("no regular file")
    try:
        with zipfile.ZipFile(file) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > most:
            raise ValueError(
                f"unpacks to {size / 1e6:.0f} MB, more than {most / 1e6:.0f}"
            )
        with np.load(file, allow_pickle=False) as arrays:
            return {key: _truth(np.asarray(arrays[key])) for key in arrays.files}
    except (*DAMAGED, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(
            str(error).splitlines()[0] if str(error) else type(error).__name__
        ) from error


def misfit(value: Any, shape: Any, where: str = "it") -> str | None:
    """What in plain nested containers, as of JSON, has another shape than it must;
    None: nothing.

    shape: a type or several; [shape] for a list of any length; {name: shape} for a dict
    with these keys and others; a shape under the name ... is that of every other key.
    """
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            return f"{where} is no object"
        parts = [
            (f"{where}.{name}", name, each)
            for name, each in shape.items()
            if name is not ...
        ]
        missing = next((at for at, name, _ in parts if name not in value), None)
        if missing:
            return f"{missing} is missing"
        others = (
            [
                (f"{where}.{name}", name, shape[...])
                for name in value
                if name not in shape
            ]
            if ... in shape
            else []
        )
        return next(
            (
                found
                for at, name, each in parts + others
                if (found := misfit(value[name], each, where=at))
            ),
            None,
        )
    if isinstance(shape, list):
        if not isinstance(value, list):
            return f"{where} is no list"
        each = (
            misfit(part, shape[0], where=f"{where}[{index}]")
            for index, part in enumerate(value)
        )
        return next((found for found in each if found), None)
    return None if isinstance(value, shape) else f"{where} is {str(value)[:40]!r}"


def _truth(array: np.ndarray) -> np.ndarray:
    """The array; one of truth values with bytes 0 and 1 only, as numpy counts on."""
    return (
        array.view(np.uint8) != 0 if array.dtype.kind == "b" and array.shape else array
    )


# --- weights


def weight_bytes(weights: Mapping[str, Tensor], header: Mapping[str, str]) -> bytes:
    """The content of a file with weights, header and hash: equal weights make equal
    bytes."""
    plain = {key: value.detach().cpu().contiguous() for key, value in weights.items()}
    return _in_order(save(plain, {**header, HASH: _digest(plain, header)}))


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Weights and header, without the hash, of a safetensors file; ValueError where it
    is none, where it is not what was written, and where a weight is NaN or infinite."""
    try:
        with safe_open(path, "pt") as file:
            header = dict(file.metadata() or {})
            weights = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, OSError, UnicodeError) as error:
        raise ValueError(str(error)) from error
    written = header.pop(HASH, None)
    if written is not None and written != _digest(weights, header):
        raise ValueError("its content is not what was written")
    bad = [
        key
        for key, value in weights.items()
        if value.is_floating_point() and not bool(value.isfinite().all())
    ]
    if bad:
        raise ValueError(f"{bad[0]} holds NaN or infinite values")
    return weights, header


def unlike(make: Callable[[], nn.Module], weights: Mapping[str, Tensor]) -> str | None:
    """What in the weights has another name or shape than in a network, of which nothing
    is allocated; None: nothing."""
    with torch.device("meta"):
        own = make().state_dict()
    if other := sorted(set(own) ^ set(weights)):
        return f"{other[0]} is {'missing' if other[0] in own else 'unknown'}"
    wrong = (name for name, value in own.items() if value.shape != weights[name].shape)
    return next(
        (
            f"{name} has shape {tuple(weights[name].shape)}, not {tuple(own[name].shape)}"
            for name in wrong
        ),
        None,
    )


def _in_order(content: bytes) -> bytes:
    """A safetensors file with its header's keys in order, which safetensors shuffles."""
    end = 8 + int.from_bytes(content[:8], "little")
    head = json.dumps(
        json.loads(content[8:end]), sort_keys=True, separators=(",", ":")
    ).encode()
    head += b" " * (-len(head) % 8)  # the tensors stay aligned
    return len(head).to_bytes(8, "little") + head + content[end:]


def _digest(weights: Mapping[str, Tensor], header: Mapping[str, str]) -> str:
    """SHA-256 of the header and of every tensor's name, type, shape and bytes."""
    digest = hashlib.sha256(repr(sorted(header.items())).encode())
    for key, value in sorted(weights.items()):
        digest.update(f"{key} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
