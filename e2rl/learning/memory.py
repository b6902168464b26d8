"""The memory of D': the traffic of this round and of earlier ones, in memory-mapped files under a run's folder.

One file memory/round-000003.safetensors a round. Of a mapped file only the rows that are drawn are read, so resident
memory does not grow with the rounds.
"""

import tempfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.run.settings import check_range
from e2rl.traffic.pool import TrafficPool

FOLDER, CHUNK = "memory", 1 << 22  # bytes that are read at once for a checksum


@dataclass(frozen=True)
class Remembered:
    """The mapped traffic of a round: number, what the file holds, and the file's checksum."""

    number: int
    traffic: dict[str, Tensor]
    crc32: int

    def __len__(self) -> int:
        return len(self.traffic["scene_index"])


class Memory:
    """The rounds from the newest one back, at most `bound` rows together; the newest round always stays.

    A round's traffic {scene_index [R], eta [R], template [R], states [R, T+1, N, 4], valid [R, T+1, N], adversaries
    [R, N], evasion [R, T, 2], span [R, 2], ...} is written by `write`, by any process, and enters by `take`. Files of
    rounds that have left go in `prune`: until then a checkpoint may name them.
    """

    def __init__(self, folder: Path | None, bound: int) -> None:
        """folder: of the run (None: a temporary one); bound: rows. Raises InputError for a negative bound."""
        check_range("learner.round.memory", bound, 0)
        if folder is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="e2rl-memory-")
            folder = Path(self._temporary.name)
        self.folder, self.bound = Path(folder) / FOLDER, bound
        self.rounds: list[Remembered] = []

    @property
    def rows(self) -> int:
        """Rows of all rounds in memory."""
        return sum(map(len, self.rounds))

    def path(self, number: int) -> Path:
        """The file of a round."""
        return self.folder / f"round-{number:06d}.safetensors"

    def write(self, number: int, traffic: Mapping[str, Tensor]) -> None:
        """Write the traffic of a round."""
        plain = {name: value.detach().cpu().contiguous() for name, value in traffic.items()}
        write_atomically(self.path(number), save(plain))

    def take(self, number: int) -> dict[str, Tensor]:
        """Map a written round as the newest; the oldest rounds beyond the bound leave. Returns its traffic."""
        path = self.path(number)
        self.rounds.append(Remembered(number, _mapped(path), _checksum(path)))
        while self.rows > self.bound and len(self.rounds) > 1:
            del self.rounds[0]
        return self.rounds[-1].traffic

    def pool(self, fresh: float) -> TrafficPool:
        """Rows of all rounds, the newest first, whose rows weigh `fresh` times as much as the others'. The tracks stay
        in their files."""
        *older, newest = (_pool(one.traffic) for one in self.rounds)
        joined = replace(newest, weight=newest.weight * fresh)
        for pool in reversed(older):
            joined = joined + replace(pool, fresh=torch.zeros_like(pool.fresh))
        return joined

    def index(self) -> list[dict[str, int]]:
        """The rounds in memory by number and checksum, the oldest first, for a checkpoint."""
        return [{"round": one.number, "crc32": one.crc32} for one in self.rounds]

    def restore(self, index: list[dict[str, int]]) -> None:
        """Map the rounds of an `index`; raises InputError for a missing, damaged or exchanged file."""
        self.rounds = []
        for entry in index:
            path = self.path(entry["round"])
            traffic, crc32 = _mapped(path), _checksum(path)
            if crc32 != entry["crc32"]:
                raise InputError(f"{path}: damaged, or not of this run; restore it or begin a new run")
            self.rounds.append(Remembered(entry["round"], traffic, crc32))

    def prune(self, first: int) -> None:
        """Delete the files of rounds before `first`."""
        for path in sorted(self.folder.glob("round-*.safetensors")):
            if path < self.path(first):
                path.unlink()


def _pool(traffic: Mapping[str, Tensor]) -> TrafficPool:
    return TrafficPool.stored(traffic, traffic["eta"], traffic["template"])


def _mapped(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise InputError(f"{path}: this file of the run's memory is missing; restore it or begin a new run")
    try:
        return load_file(path)  # maps the file: its pages are read when they are used
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path}: damaged ({error}); restore it or begin a new run") from None


def _checksum(path: Path) -> int:
    crc32 = 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            crc32 = zlib.crc32(chunk, crc32)
    return crc32
