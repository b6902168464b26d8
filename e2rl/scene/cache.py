"""The cache of scenes on disk: one file a set, mapped into the memory of all processes that use it.

A file holds the records of the scenes one after another (`e2rl.scene.packed`), an index as JSON, and END: the index's
length, FORMAT, and the SHA-256 of all that is before it. It is written scene by scene.
"""

import hashlib
import json
import mmap
import os
import struct
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from tqdm import tqdm

from e2rl.errors import InputError
from e2rl.files import locked, write_atomically
from e2rl.scene.packed import Packed, number_type
from e2rl.scene.packed_rows import Layout, PackedRows
from e2rl.scene.scene import RAGGED, SceneSet

FORMAT = b"e2rl-scenes-cache/1"
END = struct.Struct(f"<Q{len(FORMAT)}s32s")
FILES = "scenes-*"  # of a cache folder
Keep = Callable[[bytes], object]  # takes the records of a set's scenes, one after another


@dataclass
class Index:
    """What is known of a set besides its records: names, and by which bytes each record ends."""

    scene_id: list[str] = field(default_factory=list)
    location: list[str] = field(default_factory=list)
    digest: list[str] = field(default_factory=list)
    end: list[int] = field(default_factory=list)
    layout: Layout = field(default_factory=dict)
    dataset: str = ""
    split: str = ""
    dropped: dict[str, int] = field(default_factory=Counter)

    def add(self, scene_id: str, location: str, scene: Packed) -> None:
        """Add a scene; raises InputError where it does not fit to those before it."""
        for key, (kind, shape) in scene.layout.items():
            largest = self.layout.setdefault(key, (kind, shape))[1]
            if largest != shape and key not in RAGGED:
                raise InputError(f"scenes of different {key} shapes cannot be one set; build them with equal settings")
            self.layout[key] = kind, tuple(map(max, largest, shape))
        self.scene_id.append(scene_id)
        self.location.append(location)
        self.digest.append(scene.digest)
        self.end.append((self.end[-1] if self.end else 0) + len(scene.record))

    def scenes(self, records: Sequence[bytes | memoryview], room: int) -> SceneSet:
        """The set of these records."""
        rows = PackedRows(records, self.layout, self.digest, room)
        return SceneSet(rows, self.scene_id, self.location, self.dataset, self.split, dict(self.dropped))


class MappedRecords(Sequence):
    """The records of a file, read where they lie: processes that map the same file share its pages."""

    def __init__(self, file: IO[bytes], end: Sequence[int]) -> None:
        self.map, self.end = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), [0, *end]

    def __len__(self) -> int:
        return len(self.end) - 1

    def __getitem__(self, index):
        if hasattr(mmap, "MADV_DONTNEED"):  # what was read before stays in the system's cache, not in this process
            self.map.madvise(mmap.MADV_DONTNEED)
        return memoryview(self.map)[self.end[index] : self.end[index + 1]]


def cached(path: Path, build: Callable[[Keep], Index], room: int, gigabytes: float) -> SceneSet:
    """The scenes in a cache file; where it is not there or damaged, build(keep) makes them. Of several processes one
    builds, and the others wait for it. room: scenes kept unpacked; gigabytes: of all files of the folder, beyond which
    those that were not used for longest are removed."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path):
            found = read(path, room)
            if found is None:
                for left in path.parent.glob(f".{path.name}.*.part"):  # of a process that was killed while it built
                    left.unlink(missing_ok=True)
                write_atomically(path, lambda part: write(part, build))
                make_room(path, gigabytes)
                found = read(path, room)
                if found is None:
                    raise OSError("what was written is not what is read")
            os.utime(path)
            return found
    except OSError as error:
        mend = "free space, or pass another, writable folder"
        raise InputError(f"data.cache={path.parent}: cannot be made or written ({error}); {mend}") from error


def read(path: Path, room: int) -> SceneSet | None:
    """The scenes in a cache file, None where it is not there or not what was written."""
    if not path.exists():
        return None
    try:
        with path.open("rb") as file:
            index = _index(file)
            return index.scenes(MappedRecords(file, index.end), room)
    except (ValueError, TypeError, LookupError, AttributeError, OSError) as error:
        tqdm.write(f"rebuilding the damaged cache file {path}: {error}", sys.stderr)
        return None


def _index(file: IO[bytes]) -> Index:
    """The index of a cache file; raises ValueError where the file is not what was written."""
    size = os.fstat(file.fileno()).st_size - END.size
    if size < 0:
        raise ValueError("it is too short")
    file.seek(size)
    length, name, digest = END.unpack(file.read())
    if name != FORMAT or length > size:
        raise ValueError("it is no file of scenes")
    file.seek(0)
    if _digest(file, size) != digest:
        raise ValueError("its content is not what was written")
    file.seek(size - length)
    found = json.loads(file.read(length))
    layout = {key: (number_type(kind).str, tuple(shape)) for key, (kind, shape) in found.pop("layout").items()}
    return Index(**found, layout=layout)


def _digest(file: IO[bytes], size: int) -> bytes:
    """SHA-256 of the next `size` bytes."""
    digest = hashlib.sha256()
    while size > 0 and (piece := file.read(min(size, 1 << 20))):
        digest.update(piece)
        size -= len(piece)
    return digest.digest()


def write(path: Path, build: Callable[[Keep], Index]) -> None:
    """Write the file of the set that build(keep) makes."""
    digest = hashlib.sha256()
    with path.open("wb") as file:

        def keep(content: bytes) -> None:
            digest.update(content)
            file.write(content)

        index = json.dumps(vars(build(keep))).encode()
        keep(index)
        file.write(END.pack(len(index), FORMAT, digest.digest()))


def make_room(path: Path, gigabytes: float) -> None:
    """Remove the files of a cache folder that were not used for longest, until all have so many 10^9 bytes; not `path`.
    Whoever has mapped a file keeps what is in it."""
    known = [(file.stat(), file) for file in path.parent.glob(FILES) if file.exists()]
    total = sum(about.st_size for about, _ in known)
    for about, file in sorted(known, key=lambda entry: entry[0].st_mtime):
        if total > gigabytes * 1e9 and file != path:
            file.unlink(missing_ok=True)
            total -= about.st_size
            tqdm.write(f"data.cache_gb={gigabytes:g}: removed {file}, which was not used for longest", sys.stderr)
