"""Sources of scenes: from a group in conf/data to a SceneSet.

A source is one dataclass and one YAML file in conf/data, whose `_target_` names the class; an outside package adds its
own in the same way. The class says which logs there are and reads one log. `Source` does the rest: start frames,
parallel building, a cache keyed by content, and the count of what is left out.
"""

import hashlib
import json
import sys
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import ClassVar, NamedTuple

from hydra.utils import get_class
from tqdm import tqdm

from e2rl.run.config import Extension
from e2rl.run.errors import InputError
from e2rl.run.processes import interrupts_held, without_main, worker_pool
from e2rl.run.settings import check_range, settings_of
from e2rl.scenes.builder import BuildSettings, SceneBuilder, ego_overlaps
from e2rl.scenes.recording import Recording
from e2rl.scenes.scene import SceneSet, validate
from e2rl.scenes.scene_cache import Index, Keep, Packed, cached, pack
from e2rl.scenes.scene_list import listed_scenes

OVERLAP, TOO_SHORT = "ego overlaps a vehicle at the start", "too short for a start frame"  # why scenes are left out
VERSION = 4  # of the scene builder: raise it when the same recording would make another scene
AHEAD = 4  # logs for each worker that are built before their scenes are asked for
FEW = 16  # scenes that are built here before processes would have started
NO_MATTER = "path", "cache", "cache_gb", "unpacked", "workers"  # settings that do not change the scenes


class Row(NamedTuple):
    """What one recording made: a scene, or the reason why there is none."""

    scene_id: str
    location: str = ""
    dataset: str = ""
    scene: Packed | None = None
    reason: str = ""


@dataclass
class Source(Extension, ABC):
    """Where recordings come from. A subclass is a dataclass whose fields are the keys of its YAML file.

    It defines `logs` and `read`, and `fingerprint` where its scenes are to be cached.

    path: file or folder of the logs, for sources that need one; split: train, tune or test where `has_splits`, else the
    name of the split in tables (default: the stem of `path`); starts: start frames of the scenes that are cut from each
    log (default: see `Recording.windows`); mirror: also each log's mirror image, whose place is the log's;
    skip_invalid: leave invalid scenes out and count them, instead of raising InputError for the first; cache: folder;
    cache_gb: its size, in 10^9 bytes; unpacked: scenes that a process keeps unpacked at most, unless it asks for all;
    workers: processes that build; build: sizes of a scene.
    """

    path: str | None = None
    split: str | None = None
    starts: tuple[int, ...] | None = None
    mirror: bool = False
    skip_invalid: bool = False
    cache: str = ".cache"
    cache_gb: float = 20.0
    unpacked: int = 512
    workers: int = 2
    build: BuildSettings = BuildSettings()

    has_splits: ClassVar[bool] = False  # whether `split` chooses among the recordings
    holds: ClassVar[str] = "recorded logs"  # what `path` holds, for messages

    @abstractmethod
    def logs(self) -> list[str]:
        """Names of the logs, in order; they identify the logs in messages. Raises InputError where there is none."""

    @abstractmethod
    def read(self, log: str) -> Iterator[Recording]:
        """The recordings of one log, called in a process that may be another one. Raises InputError for a bad log."""

    def fingerprint(self) -> bytes | None:
        """What changes whenever the recordings do (see `hash_files`); None: the scenes are not cached."""
        return None

    @property
    def split_name(self) -> str:
        """Name of the split in tables."""
        return self.split or Path(self.path or "").stem

    def root(self) -> Path:
        """`path`; raises InputError where it is not set or not there."""
        if not self.path:
            raise InputError(f"data.path is not set; pass data.path=FOLDER_OR_ZIP of {self.holds}")
        if not Path(self.path).exists():
            raise InputError(f"data.path={self.path}: no such file or folder; pass one that holds {self.holds}")
        return Path(self.path)

    def recordings(self) -> Iterator[Recording]:
        """All recordings, one for each scene, read in this process."""
        for log in self.logs():
            for windows in self._windows(log):
                yield from windows

    def load(self, most: int | None = None) -> SceneSet:
        """All scenes or the first `most`, from the cache where they are there; raises InputError for bad input.

        For the first `most`, no more logs are built than they take, unless the cache has all.
        """
        if (
            type(self).__module__ == "__mp_main__"
        ):  # a worker that imports its script anew, and would wait for its parent
            raise InputError('a script that defines its own source needs `if __name__ == "__main__":` around its calls')
        check_range("data.unpacked", self.unpacked, 1)
        check_range("data.cache_gb", self.cache_gb, 0.0)
        content = self.fingerprint()
        if content is None:
            records: list[bytes] = []
            return self._build(most, records.append).scenes(records, self.unpacked)
        settings = asdict(self) | {"split": self.split_name, "source": type(self).__qualname__}
        settings = {key: value for key, value in settings.items() if key not in NO_MATTER}
        key = hashlib.sha256(json.dumps([VERSION, settings], sort_keys=True).encode() + content).hexdigest()[:24]
        every = Path(self.cache) / f"scenes-{key}.packed"
        how = self.unpacked, self.cache_gb
        if most is None or every.exists():
            scenes = cached(every, partial(self._build, None), *how).first(most)
        else:
            scenes = cached(every.with_stem(f"{every.stem}-{most}"), partial(self._build, most), *how)
        return replace(scenes, files=hashlib.sha256(content).hexdigest())

    def _windows(self, log: str) -> Iterator[list[Recording]]:
        """The recordings that one log makes, those of the same tracks and map together."""
        for recording in self.read(log):
            if self.mirror:  # both are of one place, or else of one log
                recording = replace(recording, location=recording.location or recording.scene_id)
            for each in (recording, recording.mirrored()) if self.mirror else (recording,):
                yield list(each.windows(self.starts, self.build.steps))

    def _rows_of(self, log: str) -> list[Row]:
        """What the recordings of one log make."""
        try:
            rows = [row for windows in self._windows(log) for row in self._rows(log, windows)]
        except InputError as error:
            return [Row(log, reason=_naming(log, error))]
        return rows or [Row(log, reason=TOO_SHORT)]

    def _rows(self, log: str, windows: list[Recording]) -> list[Row]:
        """What recordings of the same tracks and map make."""
        try:
            builder = SceneBuilder(windows[0], self.build) if windows else None
        except InputError as error:
            return [_row_of(window)._replace(reason=_naming(log, error)) for window in windows]
        return [_row(log, window, builder) for window in windows if builder]

    def rows(self, most: int | None = None) -> Generator[Row]:
        """What the logs make, in their order, of which `most` scenes are asked for (None: all). `workers` processes
        build, never far ahead of what is asked for; this one where there is work for one, or for FEW scenes."""
        logs = self.logs()
        show = partial(tqdm, desc="building scenes", total=len(logs), unit="log", disable=None)
        if min(self.workers, len(logs)) <= 1 or (most is not None and most <= FEW):
            yield from (row for rows in show(map(self._rows_of, logs)) for row in rows)
            return
        own = type(self).__module__ == "__main__"  # then the workers need the script that defines it
        try:
            with worker_pool(self.workers, "spawn") as pool:
                coming = iter(logs)
                waiting: deque[Future[list[Row]]] = deque()
                for _ in show(logs):
                    with interrupts_held(), nullcontext() if own else without_main():
                        ahead = islice(coming, AHEAD * self.workers - len(waiting))
                        waiting.extend(pool.submit(self._rows_of, log) for log in ahead)
                    yield from waiting.popleft().result()
        except BrokenProcessPool as error:
            raise InputError(
                f"data.workers={self.workers}: a process that builds scenes was killed, perhaps for lack of memory, or "
                'did not start, as in a script without `if __name__ == "__main__":`; set data.workers=1'
            ) from error

    def _build(self, most: int | None, keep: Keep) -> Index:
        """Give the records of all logs, or the first `most`, to `keep`, and return what is known of them.

        Raises InputError for an invalid one, unless `skip_invalid`, and where there is none.
        """
        index = Index(split=self.split_name)
        with closing(self.rows(most)) as rows:  # the progress bar ends before a message
            for row in rows:
                if row.scene is not None:
                    index.dataset = index.dataset or row.dataset
                    index.add(row.scene_id, row.location, row.scene)
                    keep(row.scene.record)
                    if len(index.scene_id) == most:
                        break
                elif row.reason in (OVERLAP, TOO_SHORT):
                    index.dropped[row.reason] += 1
                elif self.skip_invalid:
                    index.dropped["invalid"] += 1
                    tqdm.write(f"left out {row.scene_id}: {row.reason}", sys.stderr)
                else:
                    raise InputError(f"{row.reason} (data.skip_invalid=true leaves such scenes out)")
        if not index.scene_id:
            left_out = ", ".join(f"{count} {reason}" for reason, count in index.dropped.items())
            data = self.path or f"split {self.split_name}"
            raise InputError(f"no valid scene in {data} ({left_out}); see the messages above, or pass other data")
        return index


def _row_of(recording: Recording) -> Row:
    """A row without a scene."""
    return Row(recording.scene_id, recording.location, recording.dataset)


def _row(log: str, recording: Recording, builder: SceneBuilder) -> Row:
    """What a recording makes, one of those of a builder."""
    row = _row_of(recording)
    try:
        scene = builder.scene(recording)
        validate(scene, recording.scene_id)
    except InputError as error:
        return row._replace(reason=_naming(log, error))
    if ego_overlaps(scene):
        return row._replace(reason=OVERLAP)
    return row._replace(scene=pack({key: value.numpy() for key, value in scene.items()}))


def load_scenes(
    data: Mapping | Source,
    num_scenes: int | None = None,
    split: str | None = None,
    starts: list[int] | None = None,
    scenes: str | Path | None = None,
    files: str = "",
) -> SceneSet:
    """At most `num_scenes` scenes of a source, or of the source that a `data` group (conf/data/*.yaml) names.

    split: overrides the source's own where `Source.has_splits`; starts: overrides its start frames; scenes: a list
    (e2rl/scenes/scene_list.py), of which all or the first `num_scenes` are taken; files: see `listed_scenes`. Raises
    InputError for a source that cannot be built, for a missing or empty path, for a scene of the list that is not there
    and, unless data.skip_invalid, for an invalid scene.
    """
    if num_scenes is not None:
        check_range("num_scenes", num_scenes, 1)
    source = data if isinstance(data, Source) else source_of(data)
    if split and source.has_splits:
        source = replace(source, split=split)
    if starts is not None:
        source = replace(source, starts=tuple(starts))
    if scenes is not None:
        return listed_scenes(scenes, source.load, num_scenes, files)
    return source.load(num_scenes)


def source_of(data: Mapping) -> Source:
    """The source that the `_target_` of a `data` group names, with the other keys as its settings."""
    target = str(data.get("_target_"))
    try:
        kind = get_class(target)
    except Exception as error:  # importing a module raises anything
        reason = error.__cause__ or error
        raise InputError(f"data={target}: cannot be built: {reason}; name a subclass of Source as _target_") from error
    if not issubclass(kind, Source):
        raise InputError(f"data={target}: is no e2rl.scenes.source.Source; subclass it, and define logs() and read()")
    build = settings_of(BuildSettings, data.get("build", {}), "data.build")
    values = {key: value for key, value in data.items() if key not in ("_target_", "build")}
    return replace(settings_of(kind, values, "data"), build=build)


def hash_files(paths: Iterable[Path]) -> bytes:
    """SHA-256 of the names and contents of files, for `Source.fingerprint`; of a pipe or a link to nothing of its name.

    Raises InputError for a file that cannot be read.
    """
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode())
        if not path.is_file():
            continue
        try:
            with open(path, "rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}; make it readable, or remove it") from error
    return digest.digest()


def _naming(log: str, error: InputError) -> str:
    """An error's message, with the log that it is about."""
    return str(error) if str(error).startswith(log) else f"{log}: {error}"
