"""The cache of scenes: one file for each set, mapped into the memory of all processes
that read it.

A file holds every key's array [S, ...] of all scenes, padded to the set's largest
scene; an index as JSON; and END: the length of the index, FORMAT, and the SHA-256 of
all that is before it.
"""

import hashlib
import json
import os
import re
import struct
import sys
from collections import Counter
from collections.abc import (
    Callable,
    Iterator,
    Mapping,
)
from dataclasses import (
    dataclass,
    field,
)
from math import prod
from pathlib import Path
from tempfile import (
    TemporaryDirectory,
    TemporaryFile,
)
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from tensordict import TensorDict
from tqdm import tqdm

from e2rl.run.errors import InputError
from e2rl.run.files import (
    locked,
    write_atomically,
)
from e2rl.scenes.scene import (
    RAGGED,
    SceneSet,
)

FORMAT = b"e2rl-scenes-cache/3"
END = struct.Struct(f"<Q{len(FORMAT)}s32s")
ALIGN = 64  # bytes of which the place of every array is a multiple
DAMAGED = (ValueError, TypeError, LookupError, AttributeError, struct.error, OSError)
NAME = re.compile(r"scenes-[0-9a-f]{64}\.map")  # of a file of the cache


@dataclass
class Index:
    """What is known of a set besides its arrays. layout: each key's type, and the shape
    to which it is padded."""

    scene_id: list[str] = field(default_factory=list)
    location: list[str] = field(default_factory=list)
    layout: dict[str, tuple[str, tuple[int, ...]]] = field(default_factory=dict)
    dataset: str = ""
    split: str = ""
    dropped: dict[str, int] = field(default_factory=Counter)

    def add(
        self,
        scene_id: str,
        location: str,
        scene: Mapping[str, ndarray],
    ) -> None:
        """Adds a scene; raises InputError where it does not fit to those before it."""
        for key, value in scene.items():
            kind, largest = self.layout.setdefault(key, (value.dtype.str, value.shape))
            if largest != value.shape and key not in RAGGED:
                raise InputError(
                    f"scenes of different {key} shapes cannot be one set; "
                    "build them with equal settings"
                )
            self.layout[key] = kind, tuple(map(max, largest, value.shape))
        self.scene_id.append(scene_id)
        self.location.append(location)

    def places(self) -> tuple[dict[str, slice], int]:
        """Returns the bytes of a file that each key's array has, and how many all have,
        at least one."""
        places = {}
        begin = 0
        for key, (kind, shape) in self.layout.items():
            size = len(self.scene_id) * prod(shape) * np.dtype(kind).itemsize
            places[key] = slice(begin, begin + size)
            begin += -(-size // ALIGN) * ALIGN
        return places, max(begin, 1)

    def arrays(self, content: ndarray) -> dict[str, ndarray]:
        """Returns each key's array [S, ...] in the bytes of a file."""
        places, _ = self.places()
        return {
            key: content[places[key]].view(kind).reshape((len(self.scene_id), *shape))
            for key, (kind, shape) in self.layout.items()
        }


# yields a set's scenes when they are in its index
Build = Callable[[Index], Iterator[Mapping[str, ndarray]]]


def cached(
    path: Path,
    build: Build,
    gigabytes: float,
) -> SceneSet:
    """Returns the scenes in a cache file; where it is not there or damaged, it is
    built.

    Of several processes one builds, and the others wait for it. Raises InputError where
    the file, which has a NAME, cannot be written. gigabytes: see `make_room`.
    """
    try:
        path.parent.mkdir(
            parents=True,
            exist_ok=True,
        )
        with locked(path):
            scenes = read(path)
            if scenes is None:
                # of a process that was killed while it built
                for rest in path.parent.glob(f".{path.name}.*.part"):
                    rest.unlink(missing_ok=True)
                write_atomically(path, lambda part: write(part, build))
                make_room(path, gigabytes)
                scenes = read(path)
            if scenes is None:
                raise OSError("what was written is not what is read")
            os.utime(path)
            return scenes
    except OSError as error:
        raise InputError(
            f"data.cache={path.parent}: cannot be made or written ({error}); "
            "free space, or pass another, writable folder"
        ) from error


def uncached(build: Build) -> SceneSet:
    """Returns the scenes that `build` yields, in a file that is removed at once and
    lives as long as it is mapped."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scenes"
        write(path, build)
        scenes = read(path)
    assert scenes is not None
    return scenes


def read(path: Path) -> SceneSet | None:
    """Returns the scenes in a cache file, None where it is not there or not what was
    written.

    They are mapped copy-on-write: whoever changes them changes the own process's only.
    """
    if not path.exists():
        return None
    try:
        content = np.asarray(np.memmap(path, np.uint8, "c"))
        body = content[: -END.size]
        length, name, digest = END.unpack(content[-END.size :].tobytes())
        if name != FORMAT:
            raise ValueError(f"its format is {name.decode()}, not {FORMAT.decode()}")
        if hashlib.sha256(body.data).digest() != digest:
            raise ValueError("its content is not what was written")
        index = Index(**json.loads(body[-length:].tobytes()))
        arrays = index.arrays(content)
        scenes = {key: torch.from_numpy(value) for key, value in arrays.items()}
    except DAMAGED as error:
        tqdm.write(f"rebuilding the cache file {path}: {error}", sys.stderr)
        return None
    count = len(index.scene_id)
    scenes["scene_index"] = torch.arange(count)
    return SceneSet(
        scenes=TensorDict(scenes, [count]),
        scene_id=index.scene_id,
        location=index.location,
        dataset=index.dataset,
        split=index.split,
        dropped=dict(index.dropped),
    )


def write(path: Path, build: Build) -> None:
    """Writes the file of a set. Scenes wait in a temporary file until the largest is
    known: they may be many."""
    index = Index()
    shapes: list[list[tuple[int, ...]]] = []
    with TemporaryFile(dir=path.parent) as waiting:
        for scene in build(index):
            shapes.append([scene[key].shape for key in index.layout])
            for key, (kind, _) in index.layout.items():
                waiting.write(scene[key].astype(kind, copy=False).tobytes())
        waiting.seek(0)
        _, size = index.places()
        with path.open("wb") as file:
            file.truncate(size)
            # so that a full disk is an error here, and no crash of the mapping
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
        content = np.memmap(path, np.uint8, "r+")
        arrays = index.arrays(content)
        for number, scene_shapes in enumerate(shapes):
            for (key, rows), shape in zip(arrays.items(), scene_shapes, strict=True):
                if shape != rows.shape[1:]:
                    rows[number] = RAGGED[key]
                data = waiting.read(prod(shape) * rows.itemsize)
                place: tuple[Any, ...] = (number, *map(slice, shape))
                rows[place] = ndarray(shape, rows.dtype, data)
        content.flush()
    text = json.dumps(vars(index)).encode()
    digest = hashlib.sha256(content.data)
    digest.update(text)
    with path.open("ab") as file:
        file.write(text + END.pack(len(text), FORMAT, digest.digest()))


def make_room(path: Path, gigabytes: float) -> None:
    """Removes the cache files that were not used for longest, until all have so many
    10^9 bytes; not `path`.

    Whoever has mapped a file keeps what is in it.
    """
    files = [
        (file.stat().st_mtime, file.stat().st_size, file)
        for file in path.parent.iterdir()
        if NAME.fullmatch(file.name)
    ]
    total = sum(size for _, size, _ in files)
    for _, size, file in sorted(files):
        if total > gigabytes * 1e9 and file != path:
            file.unlink(missing_ok=True)
            total -= size
            tqdm.write(
                f"data.cache_gb={gigabytes:g}: removed {file}, "
                "which was not used for longest",
                sys.stderr,
            )
