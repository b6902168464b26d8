"""Files that appear whole or not at all, and that tell whether they still are what was written."""

import fcntl
import hashlib
import json
import os
import shutil
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from e2rl.errors import InputError

MAX_ARRAYS = 1 << 30  # bytes of one npz, unpacked
WAIT = 5  # s that another run's workers have to end
SEAL = "sha256.json"  # of a sealed folder: {file: hash}
DAMAGED = (OSError, EOFError, LookupError, TypeError, ValueError, RuntimeError, MemoryError, SyntaxError)


def write_atomically(path: Path, content: bytes | str | Callable[[Path], object]) -> None:
    """Write a file under a temporary name beside `path`, then rename it, so that no reader meets half a file.

    content: the bytes or text of the file, or a function that writes the file whose path it is given. Missing parent
    folders are made. Raises OSError, naming `path`, where it cannot be written; nothing is left behind then.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    os.close(handle)
    part = Path(name)
    try:
        if callable(content):
            content(part)
        else:
            part.write_bytes(content.encode() if isinstance(content, str) else content)
        part.chmod(0o644)
        part.replace(path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None:
            error.filename = str(path)
        raise


@contextmanager
def written_whole(folder: Path) -> Iterator[Path]:
    """An empty folder under a temporary name beside `folder`, renamed to it where the block ends well, else removed."""
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}.", suffix=".part"))
    try:
        yield part
        part.chmod(0o755)
        part.rename(folder)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def seal(folder: Path) -> None:
    """Write the hashes of a folder's files into it, for `altered`."""
    hashes = {path.name: sha256_of(path) for path in sorted(folder.iterdir()) if path.name != SEAL}
    write_atomically(folder / SEAL, json.dumps(hashes, indent=1))


def altered(folder: Path) -> str | None:
    """The name of the first file of a sealed folder that is not what was written; None: all are."""
    try:
        hashes = json.loads((folder / SEAL).read_text())
        return next((name for name, known in hashes.items() if sha256_of(folder / name) != known), None)
    except FileNotFoundError as error:
        return Path(error.filename).name
    except (OSError, ValueError, AttributeError):
        return SEAL


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's content, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of `path` among processes: others wait at the beginning of their block."""
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
    """Have a run's folder for oneself; raises InputError where another process is at work there."""
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
                time.sleep(1.0)  # workers of a process that was killed end soon, but not at once
        yield
    finally:
        os.close(handle)


def read_arrays(file: Path | IO[bytes]) -> dict[str, np.ndarray]:
    """The arrays of an npz, none of them pickled; raises ValueError where it is damaged or claims MAX_ARRAYS bytes."""
    if isinstance(file, Path) and not file.is_file():
        raise ValueError("no regular file")
    try:
        with zipfile.ZipFile(file) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > MAX_ARRAYS:
            raise ValueError(f"unpacks to {size / 1e6:.0f} MB, more than {MAX_ARRAYS / 1e6:.0f}")
        with np.load(file, allow_pickle=False) as arrays:
            return {key: _truth(np.asarray(arrays[key])) for key in arrays.files}
    except (*DAMAGED, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(str(error).splitlines()[0] if str(error) else type(error).__name__) from error


def misfit(value: Any, shape: Any, where: str = "it") -> str | None:
    """What in plain nested containers, as of JSON, has another shape than it must; None: nothing.

    shape: a type or several; [shape] for a list of any length; {name: shape} for a dict with these keys and others; a
    shape under the name ... is that of every other key.
    """
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            return f"{where} is no object"
        parts = [(f"{where}.{name}", name, each) for name, each in shape.items() if name is not ...]
        missing = next((at for at, name, _ in parts if name not in value), None)
        if missing:
            return f"{missing} is missing"
        others = [(f"{where}.{name}", name, shape[...]) for name in value if name not in shape] if ... in shape else []
        return next((found for at, name, each in parts + others if (found := misfit(value[name], each, at))), None)
    if isinstance(shape, list):
        if not isinstance(value, list):
            return f"{where} is no list"
        each = (misfit(part, shape[0], f"{where}[{index}]") for index, part in enumerate(value))
        return next((found for found in each if found), None)
    return None if isinstance(value, shape) else f"{where} is {str(value)[:40]!r}"


def _truth(array: np.ndarray) -> np.ndarray:
    """The array; one of truth values with bytes 0 and 1 only, as numpy counts on."""
    return array.view(np.uint8) != 0 if array.dtype.kind == "b" and array.shape else array
