"""Logs that are one file each, in a folder or a zip; read whole, at bounded size."""

import lzma
import zipfile
import zlib
from pathlib import Path
from typing import ClassVar

from e2rl.run.errors import InputError
from e2rl.scenes.source import Source, hash_files

MAX_BYTES = 1 << 26  # of one log; the largest pickle of nuScenes v1.0-mini has 4 MB, the largest XML of NGSIM as well
PIECE = 4096  # bytes of a zip unpacked at a time: at most 7,000 times as many come out
DAMAGED_ZIP = (zipfile.BadZipFile, zlib.error, lzma.LZMAError)


class LogFiles(Source):
    """A source whose logs are the files with one ending in the folder or zip at `path`. A subclass defines `read`."""

    ending: ClassVar[str]  # of a log's name, with the dot
    no_logs: ClassVar[str]  # what to do where there are none, for messages
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
            raise InputError(f"data.path={root}: holds no {self.ending} scenario; {self.no_logs}")
        return names

    def fingerprint(self) -> bytes:
        root = self.root()
        return hash_files([root] if root.is_file() else [root / log for log in self.logs()])

    def archive(self) -> zipfile.ZipFile:
        """The zip at `path`; raises InputError where its directory is damaged."""
        try:
            return zipfile.ZipFile(self.root())
        except (OSError, ValueError, RuntimeError, zipfile.BadZipFile) as error:
            raise InputError(f"data.path={self.path}: damaged zip ({error}); copy or export it again") from error

    def content(self, log: str) -> bytes:
        """The bytes of one log; raises InputError where they cannot be read or are more than MAX_BYTES."""
        root = self.root()
        try:
            if root.is_file():
                with self.archive() as archive:
                    return _member(archive, log)
            if not (root / log).is_file():
                raise InputError(f"{log} in {root}: no regular file (a pipe, or a link to nothing); remove it")
            _check_size((root / log).stat().st_size)
            return (root / log).read_bytes()
        except (OSError, EOFError, KeyError, ValueError, RuntimeError, *DAMAGED_ZIP) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{log} in {root}: cannot be read: {error}; copy or export it again") from error


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    """A member of a zip. It is read piece by piece, so that little more is unpacked than the size it claims."""
    _check_size(archive.getinfo(name).file_size)
    with archive.open(name) as stream:
        return b"".join(iter(lambda: stream.read(PIECE), b""))


def _check_size(size: int) -> None:
    if size > MAX_BYTES:
        raise ValueError(f"{size / 1e6:.0f} MB, more than the {MAX_BYTES / 1e6:.0f} MB of a log; cut it into scenarios")
