"""The parts of a run that are done, each on disk as it ends: a run that was killed goes
on from them."""

import hashlib
import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from e2rl.run.files import MAX_FILE, read_regular, write_atomically
from e2rl.run.run import PARTS

FORMAT = "e2rl-part/1"
HASHED = b"e2rl-sha256:"


@dataclass(frozen=True)
class Parts:
    """The parts of a run's stage that are on disk, in folder/parts/<stage>.

    A part holds plain values and tensors. It counts where its file is whole and its
    identity is the one asked for.

    Args:
        folder: of the run; None: nothing is written.
        stage: of the run.
        about: what all parts of the stage depend on besides the run's inputs, such as
            the weights of a round.
    """

    folder: Path | None = None
    stage: str = ""
    about: str = ""

    def result(
        self,
        name: str,
        identity: Any,
        compute: Callable[[], Any],
        valid: Callable[[Any], bool] = lambda value: True,
    ) -> Any:
        """Returns a part, where it is on disk and valid; else what is computed, which
        is written.

        Args:
            name: of the part.
            identity: what it depends on, plain values.
            compute: makes its value.
            valid: whether a value on disk counts.
        """
        value = self.load(name, identity)
        if value is None or not valid(value):
            value = compute()
            self.save(name, identity, value)
        return value

    def load(self, name: str, identity: Any) -> Any:
        """Returns the value of a part; None where it is not there, damaged, or of
        another identity."""
        if self.folder is None or not self._file(name).is_file():
            return None
        try:
            part = read_state(self._file(name), self.folder)
            fits = part["format"] == FORMAT and part["about"] == self.about
            return part["value"] if fits and part["identity"] == identity else None
        except (ValueError, TypeError, LookupError):
            return None  # damaged, or a stranger's: the part is done again

    def save(self, name: str, identity: Any, value: Any) -> None:
        """Write a part, in place of an older one of its name; a link or a pipe there is
        not written through."""
        if self.folder is None:
            return
        file = self._file(name)
        irregular = file.exists() and not file.is_file() and not file.is_dir()
        if file.is_symlink() or irregular:
            file.unlink()
        part = {
            "format": FORMAT,
            "about": self.about,
            "identity": identity,
            "value": value,
        }
        write_atomically(file, state_bytes(part))

    def _file(self, name: str) -> Path:
        assert self.folder is not None
        return self.folder / PARTS / self.stage / f"{name}.pt"


NO_PARTS = Parts()


def state_bytes(state: Any) -> bytes:
    """Returns plain values and tensors in torch's format, after its hash: as bytes, a
    full disk is an OSError."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getvalue()
    return HASHED + hashlib.sha256(content).digest() + content


def read_state(file: Path, folder: Path | None = None) -> Any:
    """Returns what `state_bytes` made, on the CPU; nothing but plain values and tensors
    is unpickled. Raises ValueError where the file is damaged, or lies outside of
    `folder` once links are followed."""
    try:
        whole = read_regular(file, within=folder)
        begin = len(HASHED) + hashlib.sha256().digest_size
        content = whole[begin:]
        if whole[:begin] != HASHED + hashlib.sha256(content).digest():
            raise ValueError("not what was written, or of another version")
        return load_plain(content)
    except Exception as error:  # damaged bytes raise anything
        raise ValueError(f"{file}: damaged ({error})") from error


def load_plain(content: bytes) -> Any:
    """Returns what torch.save wrote, plain values and tensors on the CPU. Raises
    ValueError where it would grow as it is read, as torch packs nothing and repeats
    nothing; damaged bytes raise anything."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
    packed = any(member.compress_type != zipfile.ZIP_STORED for member in members)
    size = sum(member.file_size for member in members)
    if packed or content[:2] != b"PK" or size > len(content):
        raise ValueError("packed")
    value = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    check_tensors(value)
    return value


def check_tensors(value: Any) -> None:
    """Raises ValueError where the tensors in nested containers have more than MAX_FILE
    bytes together, or are sparse."""
    waiting = [value]
    visited = set()
    size = 0
    while waiting:
        part = waiting.pop()
        if id(part) in visited:
            continue
        visited.add(id(part))
        if isinstance(part, dict):
            waiting += part.values()
        elif isinstance(part, list | tuple):
            waiting += part
        elif isinstance(part, torch.Tensor):
            strided = part.layout == torch.strided
            size += part.numel() * part.element_size() if strided else MAX_FILE
    if size > MAX_FILE:
        raise ValueError(f"its tensors have {size / 1e6:.0f} MB")
