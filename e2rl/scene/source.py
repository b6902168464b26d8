"""Sources of scenes: from a group in conf/data to a SceneSet.

A source is one dataclass and one YAML file in conf/data, whose `_target_` names the class; an outside package adds its
own in the same way. The class says which logs there are and reads one log. `Source` does the rest: start frames,
parallel building, a cache keyed by content, and the count of what is left out.
"""

import hashlib
import json
import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from hydra.utils import get_class
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict import TensorDict
from tqdm import tqdm

from e2rl.errors import InputError
from e2rl.files import locked, write_atomically
from e2rl.scene.build import BuildSettings, build_scene, ego_overlaps
from e2rl.scene.recording import Recording
from e2rl.scene.scene import SceneSet, stack, validate
from e2rl.scene.scene_list import listed_scenes
from e2rl.settings import check_range, settings_of
from e2rl.workers import interrupts_held, without_main, worker_pool

OVERLAP, TOO_SHORT = "ego overlaps a vehicle at the start", "too short for a start frame"  # why scenes are left out
STORED = ("scene_id", "location", "dataset", "split", "dropped")  # of a SceneSet in a cache file, beside its scenes
VERSION = 3  # of the scene builder: raise it when the same recording would make another scene


class Row(NamedTuple):
    """What one recording made: the arrays of a scene, or the reason why there is none."""

    scene_id: str
    location: str = ""
    dataset: str = ""
    scene: dict[str, np.ndarray] | None = None
    reason: str = ""


@dataclass
class Source(ABC):
    """Where recordings come from. A subclass is a dataclass whose fields are the keys of its YAML file.

    It defines `logs` and `read`, and `fingerprint` where its scenes are to be cached.

    path: file or folder of the logs, for sources that need one; split: train, tune or test where `has_splits`, else the
    name of the split in tables (default: the stem of `path`); starts: start frames of the scenes that are cut from each
    log (default: see `Recording.windows`); skip_invalid: leave invalid scenes out and count them, instead of raising
    InputError for the first; cache: folder; workers: processes that build; build: sizes of a scene.
    """

    path: str | None = None
    split: str | None = None
    starts: tuple[int, ...] | None = None
    skip_invalid: bool = False
    cache: str = ".cache"
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
            yield from self._windows(log)

    def load(self, most: int | None = None) -> SceneSet:
        """All scenes or the first `most`, from the cache where they are there; raises InputError for bad input.

        For the first `most`, no more logs are built than they take, unless the cache has all.
        """
        if (
            type(self).__module__ == "__mp_main__"
        ):  # a worker that imports its script anew, and would wait for its parent
            raise InputError('a script that defines its own source needs `if __name__ == "__main__":` around its calls')
        content = self.fingerprint()
        if content is None:
            return self._build(most)
        settings = asdict(self) | {"split": self.split_name, "source": type(self).__qualname__}
        settings = {key: value for key, value in settings.items() if key not in ("path", "cache", "workers")}
        key = hashlib.sha256(json.dumps([VERSION, settings], sort_keys=True).encode() + content).hexdigest()[:24]
        every = Path(self.cache) / f"scenes-{key}.safetensors"
        if most is None or every.exists():
            scenes = _cached(every, self._build).first(most)
        else:
            scenes = _cached(every.with_stem(f"{every.stem}-{most}"), partial(self._build, most))
        return replace(scenes, files=hashlib.sha256(content).hexdigest())

    def _windows(self, log: str) -> Iterator[Recording]:
        for recording in self.read(log):
            yield from recording.windows(self.starts, self.build.steps)

    def _rows_of(self, log: str) -> list[Row]:
        """What the recordings of one log make."""
        try:
            rows = [self._row(log, recording) for recording in self._windows(log)]
        except InputError as error:
            return [Row(log, reason=_naming(log, error))]
        return rows or [Row(log, reason=TOO_SHORT)]

    def _row(self, log: str, recording: Recording) -> Row:
        row = Row(recording.scene_id, recording.location, recording.dataset)
        try:
            scene = build_scene(recording, self.build)
            validate(scene, recording.scene_id)
        except InputError as error:
            return row._replace(reason=_naming(log, error))
        if ego_overlaps(scene):
            return row._replace(reason=OVERLAP)
        # Plain arrays cross the process border: tensors would each hold a shared-memory file open.
        return row._replace(scene={key: value.numpy() for key, value in scene.items()})

    def rows(self) -> Generator[Row]:
        """What the logs make, in their order; `workers` processes build (this one where there is work for one)."""
        logs = self.logs()
        show = partial(tqdm, desc="building scenes", total=len(logs), unit="log", disable=None)
        if min(self.workers, len(logs)) <= 1:
            yield from (row for rows in show(map(self._rows_of, logs)) for row in rows)
            return
        own = type(self).__module__ == "__main__"  # then the workers need the script that defines it
        try:
            with worker_pool(self.workers, "spawn") as pool:
                with interrupts_held(), nullcontext() if own else without_main():
                    waiting = [pool.submit(self._rows_of, log) for log in reversed(logs)]
                found = (waiting.pop().result() for _ in logs)  # in the logs' order, none kept
                yield from (row for rows in show(found) for row in rows)
        except BrokenProcessPool as error:
            raise InputError(
                f"data.workers={self.workers}: a process that builds scenes was killed, perhaps for lack of memory, or "
                'did not start, as in a script without `if __name__ == "__main__":`; set data.workers=1'
            ) from error

    def _build(self, most: int | None = None) -> SceneSet:
        """The scenes of all logs, or the first `most`; raises InputError for an invalid one, unless `skip_invalid`."""
        dropped: Counter[str] = Counter()
        scenes: list[dict[str, np.ndarray]] = []
        names: list[tuple[str, str, str]] = []
        with closing(self.rows()) as rows:  # the progress bar ends before a message
            for row in rows:
                if most is not None and len(scenes) >= most:
                    break
                if row.scene is not None:
                    scenes.append(row.scene)
                    names.append(row[:3])
                elif row.reason in (OVERLAP, TOO_SHORT):
                    dropped[row.reason] += 1
                elif self.skip_invalid:
                    dropped["invalid"] += 1
                    tqdm.write(f"left out {row.scene_id}: {row.reason}", sys.stderr)
                else:
                    raise InputError(f"{row.reason} (data.skip_invalid=true leaves such scenes out)")
        if not scenes:
            left_out = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
            data = self.path or f"split {self.split_name}"
            raise InputError(f"no valid scene in {data} ({left_out}); see the messages above, or pass other data")
        tensors = [TensorDict({key: torch.from_numpy(value) for key, value in scene.items()}) for scene in scenes]
        ids, locations, datasets = map(list, zip(*names, strict=True))
        return SceneSet(stack(tensors), ids, locations, datasets[0], self.split_name, dict(dropped))


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
    (e2rl/scene/scene_list.py), of which all or the first `num_scenes` are taken; files: see `listed_scenes`. Raises
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
        raise InputError(f"data={target}: is no e2rl.scene.source.Source; subclass it, and define logs() and read()")
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


def _cached(path: Path, build: Callable[[], SceneSet]) -> SceneSet:
    """The scenes in a cache file; they are built and stored where it is not there or damaged. Of several processes, one
    builds, and the others wait for it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path):
            return _stored(path) or _store(path, build())
    except OSError as error:
        mend = "free space, or pass another, writable folder"
        raise InputError(f"data.cache={path.parent}: cannot be made or written ({error}); {mend}") from error


def _stored(path: Path) -> SceneSet | None:
    """The scenes in a cache file, None where it is not there or not what was written."""
    if not path.exists():
        return None
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata()
            columns = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
        if header["sha256"] != _digest(columns, header["scenes"]):
            raise ValueError("its content is not what was written")
        names = json.loads(header["scenes"])
        return SceneSet(TensorDict(columns, batch_size=[len(names["scene_id"])]), **names)
    except (SafetensorError, KeyError, ValueError, TypeError, OSError) as error:
        tqdm.write(f"rebuilding the damaged cache file {path}: {error}", sys.stderr)
        return None


def _store(path: Path, scenes: SceneSet) -> SceneSet:
    columns = {key: value.contiguous() for key, value in scenes.scenes.items()}
    names = json.dumps({key: getattr(scenes, key) for key in STORED})
    header = {"scenes": names, "sha256": _digest(columns, names)}
    try:
        write_atomically(path, lambda part: save_file(columns, part, header))
    except SafetensorError as error:
        raise OSError(str(error)) from error
    return scenes


def _digest(columns: Mapping[str, torch.Tensor], names: str) -> str:
    """SHA-256 of scenes and of what is written about them."""
    digest = hashlib.sha256(names.encode())
    for key, value in sorted(columns.items()):
        digest.update(f"{key} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.contiguous().numpy().reshape(-1).view(np.uint8).data)
    return digest.hexdigest()
