"""Logs that are one file each, in a folder or a zip; read whole, at bounded size."""

import lzma
import resource
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar
from xml.parsers import expat

from e2rl.run.cpu import release_memory
from e2rl.run.errors import InputError
from e2rl.run.files import (
    hash_files,
    open_regular,
    read_regular,
)
from e2rl.scenes.source import Source

MAX_BYTES = 1 << 26  # of one log; the largest of nuScenes v1.0-mini and NGSIM have 4 MB
MAX_MEMORY = 1 << 30  # bytes that reading one log may take
PIECE = 4096  # bytes of a zip unpacked at a time: at most 7,000 times as many come out
DAMAGED = (
    *(OSError, EOFError, KeyError, ValueError, RuntimeError),
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
)


class LogFiles(Source):
    """A source whose logs are the files of one ending in the folder or zip at `path`. A
    subclass defines `read`."""

    ending: ClassVar[str]  # of a log's name, with the dot
    ignored: ClassVar[tuple[str, ...]] = ()  # files with that ending that are no logs

    def logs(self) -> list[str]:
        logs = [
            name
            for name in self.names(self.ending)
            if Path(name).name not in self.ignored
        ]
        if not logs:
            raise InputError(
                f"data.path={self.root()}: holds no {self.ending} scenario; "
                f"pass a folder or zip of {self.holds}"
            )
        return logs

    def names(self, ending: str) -> list[str]:
        """Returns the names of the files of an ending, in order."""
        root = self.root()
        if root.is_dir():
            files = sorted(root.rglob(f"*{ending}"))
            return [str(file.relative_to(root)) for file in files if not file.is_dir()]
        if root.is_file() and zipfile.is_zipfile(root):
            with self.archive() as archive:
                return [n for n in sorted(archive.namelist()) if n.endswith(ending)]
        raise InputError(f"data.path={root}: neither a folder nor a zip file")

    def fingerprint(self) -> bytes:
        root = self.root()
        files = [root] if root.is_file() else [root / log for log in self.logs()]
        return hash_files(files)

    def archive(self) -> zipfile.ZipFile:
        """Returns the zip at `path`; raises InputError where its directory is damaged."""
        try:
            return zipfile.ZipFile(self.root())
        except DAMAGED as error:
            raise InputError(
                f"data.path={self.path}: damaged zip ({error}); copy or export it again"
            ) from error

    def content(self, log: str) -> bytes:
        """Returns the bytes of one log; raises InputError where they cannot be read or
        are more than MAX_BYTES."""
        root = self.root()
        if root.is_file():
            with self.archive() as archive:
                return _member(archive, log)
        try:
            return read_regular(root / log, MAX_BYTES)
        except OSError as error:
            raise InputError(
                f"{log} in {root}: cannot be read: {error.strerror}; "
                "copy or export it again"
            ) from error


def xml_parser() -> expat.XMLParserType:
    """Returns a parser that raises InputError for a document type, which no log needs:
    it may name files, or grow when it is expanded."""

    def refuse(*_: object) -> None:
        raise InputError("holds a document type declaration; remove it")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    return parser


def check_file(file: Path, most: int = MAX_BYTES) -> None:
    """Raises InputError for a file of a log that is no regular one, has more than
    `most` bytes, or is not readable."""
    try:
        open_regular(file, most).close()
    except OSError as error:
        raise InputError(
            f"{file}: cannot be read: {error.strerror}; copy it again, or leave it out"
        ) from error


@contextmanager
def bounded_memory(most: int = MAX_MEMORY) -> Iterator[None]:
    """The block may allocate `most` bytes: libraries that believe what a file says it
    holds would take all there is.

    Raises InputError where it asks for more. Without effect where the system does not
    tell what a process has.
    """
    release_memory()  # or the block could take what is kept besides
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[5])
    except OSError:
        yield
        return
    soft, hard = before = resource.getrlimit(resource.RLIMIT_DATA)
    limit = pages * resource.getpagesize() + most
    if soft != resource.RLIM_INFINITY:
        limit = min(limit, soft)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    try:
        yield
    except MemoryError as error:
        raise InputError(
            f"takes more than the {most / 1e6:.0f} MB of memory of a log; "
            "cut it, or leave it out"
        ) from error
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    """Returns a member of a zip, read piece by piece, so that little more is unpacked
    than the size it claims."""
    try:
        if archive.getinfo(name).file_size > MAX_BYTES:
            raise ValueError(
                f"it has more than the {MAX_BYTES / 1e6:.0f} MB of a log; "
                "cut it into scenarios"
            )
        with archive.open(name) as stream:
            return b"".join(iter(lambda: stream.read(PIECE), b""))
    except DAMAGED as error:
        raise InputError(
            f"{name} in {archive.filename}: cannot be read: {error}; "
            "copy or export it again"
        ) from error
