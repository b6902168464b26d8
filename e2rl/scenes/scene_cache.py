"""The cache of scenes on disk: one file a set, mapped into the memory of all processes that use it.

A file holds the records of the scenes one after another, an index as JSON, and END: the index's
length, FORMAT, and the SHA-256 of all that is before it. It is written scene by scene.

Scenes as bytes, without loss and in a seventh of their size: for the cache, and for sets larger than the memory.

A record is a zlib stream of the arrays' names, types and shapes as JSON, and of the arrays one after another. Each is
taken as whole numbers of its type's size; stored are their differences along the longest axis, byte plane by byte
plane: the high bytes of smooth numbers, and padding, are zeros then.

Sets of packed scenes: a scene is unpacked when it is asked for, and kept as long as there is room.
"""

import hashlib
import json
import mmap
import os
import struct
import sys
import zlib
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from e2rl.run.errors import InputError
from e2rl.run.files import locked, write_atomically
from e2rl.scenes.scene import RAGGED, Rows, SceneSet, content_hash

LEVEL = 3  # of zlib; 6 saves 3% and takes twice as long
LARGEST = 1 << 28  # bytes that a record is unpacked to at most
LENGTH = struct.Struct("<I")


class Packed(NamedTuple):
    """The record of a scene, its arrays' types and shapes, and its `content_hash`."""

    record: bytes
    layout: dict[str, tuple[str, tuple[int, ...]]]
    digest: str


def pack(scene: Mapping[str, np.ndarray]) -> Packed:
    """A scene's arrays as a record."""
    layout = {key: (value.dtype.str, value.shape) for key, value in scene.items()}
    head = json.dumps(layout).encode()
    content = b"".join([LENGTH.pack(len(head)), head, *map(_planes, scene.values())])
    return Packed(zlib.compress(content, LEVEL), layout, content_hash(scene))


def unpack(record: bytes | memoryview) -> dict[str, np.ndarray]:
    """The arrays of a record, bit for bit; raises ValueError where it is damaged."""
    try:
        content = _inflated(record)
        begin = LENGTH.size + LENGTH.unpack_from(content)[0]
        layout, scene = json.loads(content[LENGTH.size : begin]), {}
        for key, (name, shape) in layout.items():
            dtype = number_type(name)
            end = begin + int(np.prod(shape)) * dtype.itemsize
            scene[key] = _array(content[begin:end], dtype, shape)
            begin = end
    except (zlib.error, struct.error, TypeError, LookupError, AttributeError) as error:
        raise ValueError(f"a damaged scene ({error})") from error
    return scene


def number_type(name: str) -> np.dtype:
    """The type of numbers or truth values of this name; TypeError for objects and others."""
    dtype = np.dtype(name)
    if dtype.kind not in "biuf":
        raise TypeError(f"{name} is no type of numbers")
    return dtype


def _inflated(record: bytes | memoryview) -> bytes:
    stream = zlib.decompressobj()
    content = stream.decompress(record, LARGEST)
    if not stream.eof:
        raise ValueError("a scene that is cut short, or larger than any")
    return content


def _planes(value: np.ndarray) -> bytes:
    """An array's differences, byte plane by byte plane."""
    value = np.ascontiguousarray(value)
    numbers = value.view(f"u{value.dtype.itemsize}")
    if value.size:
        axis = int(np.argmax(value.shape))
        numbers = np.diff(numbers, axis=axis, prepend=np.zeros_like(numbers.take([0], axis)))
    return numbers.reshape(-1).view(np.uint8).reshape(-1, value.dtype.itemsize).T.tobytes()


def _array(planes: bytes, dtype: np.dtype, shape: list[int]) -> np.ndarray:
    """The array of `_planes`, of at least one dimension."""
    width = dtype.itemsize
    numbers = np.frombuffer(planes, np.uint8).reshape(width, -1).T.copy().view(f"u{width}").reshape(shape)
    if numbers.size:
        np.cumsum(numbers, axis=int(np.argmax(shape)), dtype=numbers.dtype, out=numbers)
    return numbers.view(dtype)


Layout = dict[str, tuple[str, tuple[int, ...]]]  # of the arrays of a scene: type and shape


class PackedRows(Rows):
    """Scenes in records, of which the `room` that were used last are kept unpacked.

    records, digests: of all scenes of a file, and their `content_hash`; layout: types and, of ragged keys, the largest
    shape, to which all are padded; picked [S]: which records are this set's scenes (None: all).
    """

    def __init__(
        self,
        records: Sequence[bytes | memoryview],
        layout: Layout,
        digests: Sequence[str],
        room: int,
        picked: Sequence[int] | None = None,
    ) -> None:
        self.records, self.layout, self.digests = records, layout, digests
        self.picked = range(len(digests)) if picked is None else picked
        self._make_room(room)

    def __reduce__(self) -> tuple:
        """Without what is kept: another machine gets the records of this set alone."""
        records, digests = [bytes(self.records[each]) for each in self.picked], self.hashes()
        return PackedRows, (records, self.layout, digests, self.room)

    def __len__(self) -> int:
        return len(self.picked)

    def shape(self, key: str) -> tuple[int, ...]:
        return self.layout[key][1]

    def hashes(self) -> list[str]:
        return [self.digests[each] for each in self.picked]

    def chosen(self, index: Sequence[int]) -> "PackedRows":
        picked = [self.picked[each] for each in index]
        return PackedRows(self.records, self.layout, self.digests, self.room_wanted, picked)

    def whole(self) -> TensorDict:
        """All scenes, which are all kept from now on."""
        if self.room < len(self):
            self._make_room(len(self))
        return self.resident(torch.arange(len(self)))[0]

    def resident(self, index: Tensor) -> tuple[TensorDict, Tensor]:
        wanted = index.unique()
        if len(wanted) > self.room:
            apart = self._empty(len(wanted))
            for place, scene in enumerate(wanted.tolist()):
                self._write(apart, place, scene, self._unpacked(scene))
            return apart, torch.searchsorted(wanted, index)
        for scene in wanted.tolist():
            if scene in self._places:
                self._places.move_to_end(scene)
        for scene in wanted.tolist():
            if scene not in self._places:
                content = self._unpacked(scene)
                self._write(self._kept, self._place(scene), scene, content)
        return self._kept, torch.tensor([self._places[scene] for scene in index.tolist()], dtype=torch.int64)

    def _unpacked(self, scene: int) -> dict[str, np.ndarray]:
        return unpack(self.records[self.picked[scene]])

    def _make_room(self, room: int) -> None:
        self.room_wanted, self.room = room, min(room, len(self))
        self._kept, self._places = self._empty(self.room), OrderedDict[int, int]()  # scene -> row, the last used last

    def _place(self, scene: int) -> int:
        """A row for a scene that is not kept: its own where there is room for all, else a free one, or that of the
        scene that was not used for longest."""
        if self.room == len(self):
            place = scene
        elif len(self._places) < self.room:
            place = len(self._places)
        else:
            place = self._places.popitem(last=False)[1]
        self._places[scene] = place
        return place

    def _empty(self, count: int) -> TensorDict:
        """Rows that take up memory only when they are written."""
        rows = {key: torch.from_numpy(np.empty((count, *shape), dtype)) for key, (dtype, shape) in self.layout.items()}
        return TensorDict(rows | {"scene_index": torch.empty(count, dtype=torch.int64)}, batch_size=[count])

    def _write(self, rows: TensorDict, place: int, scene: int, content: dict[str, np.ndarray]) -> None:
        rows["scene_index"][place] = scene
        for key, value in content.items():
            row = rows[key][place].numpy()
            if value.shape != row.shape:
                row.fill(RAGGED.get(key, 0))
            row[tuple(map(slice, value.shape))] = value


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
