"""The memory of D': the traffic of this round and of earlier ones, in memory-mapped
files under a run's folder.

One file memory/round-000003.safetensors a round. Of a mapped file only the rows that
are drawn are read, so resident memory does not grow with the rounds.
"""

import json
import tempfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor

from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.traffic.pool import TrafficPool

FOLDER = "memory"  # of a run
ERRORED = "errored"  # key of a file's metadata


@dataclass(frozen=True)
class Remembered:
    """The traffic of a round as its file holds it: number, mapped tensors, errored
    rows, and the file's checksum."""

    number: int
    traffic: dict[str, Tensor]
    errored: list[dict]
    crc32: int

    def __len__(self) -> int:
        return len(self.traffic["scene_index"])


class Memory:
    """The rounds from the newest one back, at most `bound` rows together; the newest
    round always stays.

    A round's traffic (`attack.make_traffic`) is written by `write`, by any process, and
    enters by `take`. Files of rounds that have left go in `prune`: until then a
    checkpoint may name them.
    """

    def __init__(self, folder: Path | None, bound: int) -> None:
        """folder: of the run (None: a temporary one); bound: rows."""
        if folder is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="e2rl-memory-")
            folder = Path(self._temporary.name)
        self.folder = Path(folder) / FOLDER
        self.bound = bound
        self.rounds: list[Remembered] = []

    @property
    def rows(self) -> int:
        """Rows of all rounds in memory."""
        return sum(map(len, self.rounds))

    def path(self, number: int) -> Path:
        """The file of a round."""
        return self.folder / f"round-{number:06d}.safetensors"

    def write(
        self,
        number: int,
        traffic: Mapping[str, Tensor],
        errored: Sequence[dict] = (),
    ) -> None:
        """Write the traffic of a round, and its errored rows."""
        plain = {
            name: value.detach().cpu().contiguous() for name, value in traffic.items()
        }
        write_atomically(
            self.path(number), save(plain, {ERRORED: json.dumps(list(errored))})
        )

    def take(self, number: int) -> Remembered:
        """Map a written round as the newest; the oldest rounds beyond the bound leave.
        Returns it."""
        self.rounds.append(self._mapped(number))
        while self.rows > self.bound and len(self.rounds) > 1:
            del self.rounds[0]
        return self.rounds[-1]

    def pool(self) -> TrafficPool:
        """Rows of all rounds, the newest first. The tracks stay in their files."""
        newest, *older = (
            TrafficPool.stored(part.traffic, part.traffic["eta"])
            for part in reversed(self.rounds)
        )
        return sum(older, newest)

    def index(self) -> list[dict[str, int]]:
        """The rounds in memory by number and checksum, the oldest first, for a
        checkpoint."""
        return [{"round": part.number, "crc32": part.crc32} for part in self.rounds]

    def restore(self, index: list[dict[str, int]]) -> None:
        """Map the rounds of an `index`; raises InputError for a missing, damaged or
        exchanged file."""
        self.rounds = [self._mapped(entry["round"]) for entry in index]
        for entry, part in zip(index, self.rounds, strict=True):
            if part.crc32 != entry["crc32"]:
                raise InputError(
                    f"{self.path(part.number)}: damaged, or not of this run; "
                    "restore it or begin a new run"
                )

    def prune(self, first: int) -> None:
        """Delete the files of rounds before `first`."""
        for path in sorted(self.folder.glob("round-*.safetensors")):
            if path < self.path(first):
                path.unlink()

    def _mapped(self, number: int) -> Remembered:
        path = self.path(number)
        if not path.is_file():
            raise InputError(
                f"{path}: this file of the run's memory is missing; "
                "restore it or begin a new run"
            )
        try:
            traffic = load_file(path)  # mapped: pages are read when they are used
            with safe_open(path, "pt") as file:
                errored = json.loads((file.metadata() or {}).get(ERRORED, "[]"))
        except (SafetensorError, OSError, ValueError) as error:
            raise InputError(
                f"{path}: damaged ({error}); restore it or begin a new run"
            ) from None
        return Remembered(
            number,
            traffic,
            errored=errored,
            crc32=zlib.crc32(path.read_bytes()),
        )
