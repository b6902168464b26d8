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

PARTS = "parts"
FORMAT = "e2rl-part/1"
HASHED = b"e2rl-sha256:"


@dataclass(frozen=True)
class Parts:
    """The parts of a run's stage that are done, in folder/parts/<stage>.

    A part holds plain values and tensors. It counts where its file is whole and its
    identity is the one asked for.

    Args:
        folder: of the run; None: nothing is written.
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
        valid: Callable[[Any], bool] = lambda found: True,
    ) -> Any:
        """Returns the part `name`, where it is there and valid; else compute(), which
        is written."""
        found = self.load(name, identity)
        if found is None or not valid(found):
            found = compute()
            self.save(name, identity, value=found)
        return found

    def load(self, name: str, identity: Any) -> Any:
        """Returns the value of a part; None where it is not there, damaged, or of
        another identity."""
        if self.folder is None or not self._file(name).is_file():
            return None
        try:
            part = read_state(self._file(name), self.folder)
            known = [part[key] for key in ("format", "about", "identity")]
            return part["value"] if known == [FORMAT, self.about, identity] else None
        except (
            ValueError,
            TypeError,
            LookupError,
        ):  # damaged, or a stranger's: the part is done again
            return None

    def save(self, name: str, identity: Any, value: Any) -> None:
        """Write a part, in place of an older one of its name; a link or a pipe there is
        not written through."""
        if self.folder is not None:
            file = self._file(name)
            if file.is_symlink() or (
                file.exists() and not file.is_file() and not file.is_dir()
            ):
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
    content = io.BytesIO()
    torch.save(state, content)
    return HASHED + hashlib.sha256(content.getvalue()).digest() + content.getvalue()


def read_state(file: Path, folder: Path | None = None) -> Any:
    """Returns what `state_bytes` made, on the CPU; nothing but plain values and tensors
    is unpickled. Raises ValueError where the file is damaged, or lies outside of
    `folder` once links are followed."""
    try:
        content = read_regular(file, within=folder)
        begin = len(HASHED) + hashlib.sha256().digest_size
        if (
            content[: len(HASHED)] != HASHED
            or hashlib.sha256(content[begin:]).digest() != content[len(HASHED) : begin]
        ):
            raise ValueError("not what was written, or of an earlier version")
        return load_plain(content[begin:])
    except Exception as error:  # damaged bytes raise anything
        raise ValueError(f"{file}: damaged ({error})") from error


def load_plain(content: bytes) -> Any:
    """Returns what torch.save wrote, plain values and tensors on the CPU. Raises
    ValueError where it would grow as it is read, as torch packs nothing and repeats
    nothing; damaged bytes raise anything."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
    packed = (
        any(each.compress_type != zipfile.ZIP_STORED for each in members)
        or content[:2] != b"PK"
    )
    if packed or sum(each.file_size for each in members) > len(content):
        raise ValueError("packed")
    value = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    waiting = [value]
    known = set()
    size = 0
    while waiting:
        part = waiting.pop()
        if id(part) not in known and isinstance(part, dict | list | tuple):
            waiting += part.values() if isinstance(part, dict) else part
        elif id(part) not in known and isinstance(part, torch.Tensor):
            size += (
                part.numel() * part.element_size()
                if part.layout == torch.strided
                else MAX_FILE
            )
        known.add(id(part))
    if size > MAX_FILE:
        raise ValueError(f"its tensors have {size / 1e6:.0f} MB")
    return value
