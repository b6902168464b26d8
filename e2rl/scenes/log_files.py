"""Logs that are one file each, in a folder or a zip; read whole, at bounded size."""

import lzma
import zipfile
import zlib
from pathlib import Path
from typing import ClassVar

from e2rl.run.errors import InputError
from e2rl.run.files import hash_files
from e2rl.scenes.source import Source

MAX_BYTES = 1 << 26  # of one log; the largest pickle of nuScenes v1.0-mini has 4 MB, the largest XML of NGSIM as well
PIECE = 4096  # bytes of a zip unpacked at a time: at most 7,000 times as many come out
DAMAGED = (*(OSError, EOFError, KeyError, ValueError, RuntimeError), zipfile.BadZipFile, zlib.error, lzma.LZMAError)


class LogFiles(Source):
    """A source whose logs are the files of one ending in the folder or zip at `path`. A subclass defines `read`."""

    ending: ClassVar[str]  # of a log's name, with the dot
    ignored: ClassVar[tuple[str, ...]] = ()  # names of files with that ending that are no logs

    def logs(self) -> list[str]:
        root = self.root()
        if root.is_dir():
            files = sorted(root.rglob(f"*{self.ending}"))
            names = [str(file.relative_to(root)) for file in files if not file.is_dir()]
        elif root.is_file() and zipfile.is_zipfile(root):
            with self.archive() as archive:
                names = [name for name in sorted(archive.namelist()) if name.endswith(self.ending)]
        else:
            raise InputError(f"data.path={root}: neither a folder nor a zip file")
        names = [name for name in names if Path(name).name not in self.ignored]
        if not names:
            raise InputError(f"data.path={root}: holds no {self.ending} scenario; pass a folder or zip of {self.holds}")
        return names

    def fingerprint(self) -> bytes:
        root = self.root()
        return hash_files([root] if root.is_file() else [root / log for log in self.logs()])

    def archive(self) -> zipfile.ZipFile:
        """Returns the zip at `path`; raises InputError where its directory is damaged."""
        try:
            return zipfile.ZipFile(self.root())
        except DAMAGED as error:
            raise InputError(f"data.path={self.path}: damaged zip ({error}); copy or export it again") from error

    def content(self, log: str) -> bytes:
        """Returns the bytes of one log; raises InputError where they cannot be read or are more than MAX_BYTES."""
        root = self.root()
        if root.is_file():
            with self.archive() as archive:
                return _member(archive, log)
        check_size(root / log)
        try:
            return (root / log).read_bytes()
        except OSError as error:
            raise InputError(f"{log} in {root}: cannot be read: {error}; copy or export it again") from error


def check_size(file: Path, most: int = MAX_BYTES) -> None:
    """Raises InputError for a file of a log that has more than `most` bytes, or is none."""
    if not file.is_file():
        raise InputError(f"{file}: no regular file (a pipe, or a link to nothing); remove it")
    if file.stat().st_size > most:
        raise InputError(f"{file.name} has more than the {most / 1e6:.0f} MB of a log; cut it, or leave it out")


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    """Returns a member of a zip, read piece by piece, so that little more is unpacked than the size it claims."""
    try:
        if archive.getinfo(name).file_size > MAX_BYTES:
            raise ValueError(f"it has more than the {MAX_BYTES / 1e6:.0f} MB of a log; cut it into scenarios")
        with archive.open(name) as stream:
            return b"".join(iter(lambda: stream.read(PIECE), b""))
    except DAMAGED as error:
        where = f"{name} in {archive.filename}"
        raise InputError(f"{where}: cannot be read: {error}; copy or export it again") from error
