"""Sources of scenes: from a group in conf/data to a SceneSet.

A source is one dataclass and one YAML file in conf/data, whose `_target_` names the
class; an outside package adds its own in the same way. The class says which logs there
are and reads one log. `Source` does the rest: start frames, parallel building, a cache
keyed by content and by the code of the class, and the count of what is left out.
"""

import hashlib
import json
import sys
from abc import (
    ABC,
    abstractmethod,
)
from collections import (
    Counter,
    deque,
)
from collections.abc import (
    Generator,
    Iterable,
    Iterator,
    Mapping,
)
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import (
    closing,
    contextmanager,
    nullcontext,
)
from dataclasses import (
    asdict,
    dataclass,
    field,
    replace,
)
from functools import partial
from itertools import (
    chain,
    count,
    islice,
)
from pathlib import Path
from typing import (
    Any,
    ClassVar,
    NamedTuple,
)

import numpy as np
from hydra.utils import get_class
from tqdm import tqdm

from e2rl.run.config import (
    Extension,
    check_range,
    check_settings,
    file_values,
    load_choice,
    setting,
    settings_of,
)
from e2rl.run.errors import InputError
from e2rl.run.extras import how_to_install
from e2rl.run.files import cache_folder
from e2rl.run.processes import (
    interrupts_held,
    without_main,
    worker_pool,
)
from e2rl.run.terminal import Bar
from e2rl.scenes.builder import (
    BuildSettings,
    SceneBuilder,
    ego_overlaps,
)
from e2rl.scenes.reader_code import (
    code_hash,
    failed_line,
)
from e2rl.scenes.recording import (
    MAX_NAME,
    Recording,
)
from e2rl.scenes.scene import (
    SceneSet,
    validate,
)
from e2rl.scenes.scene_cache import (
    Index,
    cached,
    uncached,
)
from e2rl.scenes.scene_list import listed_scenes
from e2rl.scenes.trailers import couple
from e2rl.scenes.versions import (
    MARK,
    RECORDED,
    check_versions,
    version_of,
)

OVERLAP = "ego overlaps a vehicle at the start"  # why scenes are left out
TOO_SHORT = "too short for a start frame"
NO_EGO = "nobody to be the ego at the start"
NO_VERSION = "without such a version"  # or it is invalid, and the log itself is not
VERSION = 14  # of the builder: raise it when a recording would make another scene
AHEAD = 4  # logs for each worker that are built before their scenes are asked for
OF_PATHS = (
    "scenarionet",
    "sumo",
    "commonroad",
    "argoverse2",
)  # groups `data` of a path
FEW = 16  # scenes that are built here before processes would have started
NO_MATTER = {"path", "cache", "cache_gb", "workers"}  # to the scenes


class Row(NamedTuple):
    """What one recording made: a scene's arrays, or the reason why there is none.

    usual: whether sound data have such recordings, too; repairs: what was mended in its
    tracks and map; they stand with the first recording of a log alone.
    """

    scene_id: str
    location: str = ""
    dataset: str = ""
    scene: dict[str, np.ndarray] | None = None
    reason: str = ""
    usual: bool = False
    repairs: Counter[str] = Counter()  # never changed in place


def default_of(
    key: str,
    file: str = "data/source",
    **rule: Any,
) -> Any:
    """Returns a dataclass field whose default is that of conf/<file>.yaml; rule: see
    `setting`."""
    return field(
        default_factory=lambda: file_values(file)[key],
        metadata=setting(**rule).metadata,
    )


@dataclass
class Source(Extension, ABC):
    """Where recordings come from. A subclass is a dataclass whose fields are the keys
    of its YAML file.

    It defines `logs` and `read`, and `fingerprint` where its scenes are to be cached.
    path: file or folder of the logs, for sources that need one; the other settings of
    every source: conf/data/source.yaml.
    """

    path: str | None = None
    split: str | None = default_of("split")
    starts: tuple[int, ...] | None = default_of("starts", optional=True)
    versions: tuple[str, ...] = default_of("versions")
    skip_invalid: bool = default_of("skip_invalid")
    cache: str | None = default_of("cache")
    cache_gb: float = default_of("cache_gb", low=0.0)
    workers: int = default_of("workers")
    build: BuildSettings = field(default_factory=BuildSettings)

    # hash of the code that defines the class, as it was when it was imported
    code: ClassVar[str | None] = None
    has_splits: ClassVar[bool] = False  # whether `split` chooses among the recordings
    holds: ClassVar[str] = "recorded logs"  # what `path` holds, for messages
    # what to do with a damaged log; "": any other error of `read` is the class's own
    mend: ClassVar[str] = ""
    extra: ClassVar[str] = ""  # of e2rl, with the library that `read` imports

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.code = code_hash(cls)

    def __post_init__(self) -> None:
        if isinstance(self.build, Mapping):
            self.build = settings_of(BuildSettings, self.build, where="data.build")
        check_settings(self, "data")
        check_versions(self.versions)

    @abstractmethod
    def logs(self) -> list[str]:
        """Returns the names of the logs, in order; messages name them. Raises
        InputError where there is none."""

    @abstractmethod
    def read(self, log: str) -> Iterator[Recording]:
        """Yields the recordings of one log, perhaps in another process. Raises
        InputError for a bad log."""

    def fingerprint(self) -> bytes | None:
        """Returns what changes whenever the recordings do (see `hash_files`); None: the
        scenes are not cached."""
        return None

    @property
    def split_name(self) -> str:
        """The name of the split in tables."""
        return self.split or Path(self.path or "").stem

    def root(self) -> Path:
        """Returns `path`; raises InputError where it is not set or not there."""
        if not self.path:
            raise InputError(
                f"data.path is not set; pass data.path=FOLDER_OR_ZIP of {self.holds}"
            )
        path = Path(self.path).expanduser()
        if not path.exists():
            raise InputError(
                f"data.path={self.path}: no such file or folder; "
                f"pass one that holds {self.holds}"
            )
        return path

    def recordings(self) -> Iterator[Recording]:
        """Yields all recordings, one for each scene, read in this process."""
        for log in self.log_names():
            for windows in self._windows(log):
                yield from windows

    def load(self, most: int | None = None) -> SceneSet:
        """Returns all scenes or the first `most`, from the cache where they are there;
        raises InputError for bad input.

        For the first `most`, no more logs are built than they take, unless the cache
        has all.
        """
        # a worker that imports its script anew would wait for its parent
        if type(self).__module__ == "__mp_main__":
            raise InputError(
                'a script that defines its own source needs `if __name__ == "__main__":` '
                "around its calls"
            )
        with self._errors_of("fingerprint"):
            content = self.fingerprint()
        if content is None or self.code is None:
            return uncached(partial(self._built, most))
        folder = Path(self.cache) if self.cache else cache_folder()
        count = None if (folder / self._file(content, None)).exists() else most
        scenes = cached(
            folder / self._file(content, count),
            partial(self._built, count),
            gigabytes=self.cache_gb,
        )
        return replace(scenes.first(most), files=hashlib.sha256(content).hexdigest())

    def log_names(self) -> list[str]:
        """Returns `logs`, checked; raises InputError where it fails, or returns
        anything else than a list of texts."""
        with self._errors_of("logs"):
            names = self.logs()
        is_list = isinstance(names, list | tuple)
        if is_list and all(isinstance(name, str) for name in names):
            return list(names)
        raise InputError(
            f"{type(self).__name__}.logs returns "
            f"{'other than texts' if is_list else type(names).__name__}; "
            "return a list of the names of logs"
        )

    def _file(self, content: bytes, most: int | None) -> str:
        """Returns the name of the cache file of the first `most` scenes."""
        settings = {
            key: value for key, value in asdict(self).items() if key not in NO_MATTER
        }
        settings["split"] = self.split_name
        settings["source"] = type(self).__qualname__
        key = [VERSION, self.code, settings, most]
        text = json.dumps(
            key,
            sort_keys=True,
            default=str,
        ).encode()
        return f"scenes-{hashlib.sha256(text + content).hexdigest()}.map"

    def _windows(self, log: str) -> Iterator[list[Recording]]:
        """Yields the recordings that one log makes, those of the same tracks and map
        together."""
        with self.named(log):
            for recording in self._read(log):
                recording.validate_names().validate_fields()
                if len(self.versions) > 1:  # all are of one place, or else of one log
                    place = recording.location or recording.scene_id
                    recording = replace(recording, location=place)
                for name in self.versions:
                    version = version_of(recording, name)
                    if version is not None:
                        windows = couple(version).windows(self.starts, self.build.steps)
                        yield list(windows)

    def _read(self, log: str) -> Iterator[Recording]:
        """Yields `read`; raises InputError where that is anything else than recordings."""
        recordings = self.read(log)
        name = f"{type(self).__name__}.read"
        mend = "yield e2rl.scenes.recording.Recording objects"
        if not isinstance(recordings, Iterable):
            raise InputError(f"{name} returns {type(recordings).__name__}; {mend}")
        for recording in recordings:
            if not isinstance(recording, Recording):
                raise InputError(f"{name} yields {type(recording).__name__}; {mend}")
            yield recording

    @contextmanager
    def named(self, log: str) -> Iterator[None]:
        """What `read` raises in the block is an InputError that names the log."""
        try:
            with self._errors_of("read", mend=self.mend):
                yield
        except InputError as error:
            raise InputError(_naming(log, error)) from (error.__cause__ or error)

    @contextmanager
    def _errors_of(self, method: str, mend: str = "") -> Iterator[None]:
        """What a method of the class raises in the block is an InputError, with the
        line of a user's code; with `mend`, the log is to blame for it."""
        try:
            yield
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # damaged files, too, raise anything
            line = failed_line(type(self), error.__traceback__)
            cause = f"{type(error).__name__} {str(error).partition(chr(10))[0]}"
            missing = isinstance(error, ImportError) and method == "read"
            if missing and self.extra:
                message = (
                    f"a library of its reader cannot be imported ({error}); "
                    f"{how_to_install(self.extra)}"
                )
            elif mend and not missing:
                at = f" at {line}" if line else ""
                message = f"is none of {self.holds}: {cause}{at}; {mend}"
            elif line and not missing:
                name = f"{type(self).__name__}.{method}"
                message = f"{name} failed at {line}: {cause}; mend it there"
            else:
                raise
            raise InputError(message) from error

    def _rows_of(self, log: str) -> list[Row]:
        """Returns what the recordings of one log make."""
        try:
            rows = [
                row
                for windows in self._windows(log)
                for row in self._rows(log, windows)
            ]
        except InputError as error:
            if isinstance(error.__cause__, ImportError):  # no log can be read
                raise
            return [Row(log, reason=str(error))]
        steps = f"half of data.build.steps={self.build.steps}, which may be set lower"
        reason = f"{TOO_SHORT} and {steps}" if RECORDED in self.versions else NO_VERSION
        return rows or [
            Row(
                log,
                reason=reason,
                usual=True,
            )
        ]

    def _rows(self, log: str, windows: list[Recording]) -> Iterator[Row]:
        """Yields what recordings of the same tracks and map make."""
        builder = None
        for window in windows:
            row = Row(window.scene_id, window.location, window.dataset)
            if len(windows) > 1 and not window.has_ego():
                yield row._replace(
                    reason=NO_EGO,
                    usual=True,
                )
                continue
            try:
                if builder is None:
                    builder = SceneBuilder(window, self.build)
                    row = row._replace(repairs=builder.repairs)
                scene = builder.scene(window)
                validate(scene, window.scene_id)
            except InputError as error:
                marks = [f"{MARK}{name}" for name in self.versions]
                is_version = any(mark in row.scene_id for mark in marks)
                usual = is_version and RECORDED in self.versions
                reason = NO_VERSION if usual else _naming(log, error)
                yield row._replace(
                    reason=reason,
                    usual=usual,
                )
                continue
            if overlapped := ego_overlaps(scene):
                reason = OVERLAP.replace("a vehicle", overlapped)
                yield row._replace(
                    reason=reason,
                    usual=True,
                )
            else:
                arrays = {key: value.numpy() for key, value in scene.items()}
                yield row._replace(scene=arrays)

    def rows(self, most: int | None = None) -> Generator[Row]:
        """Yields what the logs make, in their order, of which `most` scenes are asked
        for (None: all).

        `workers` processes build, never far ahead of what is asked for; this one where
        there is work for one, or for FEW scenes. Where logs share ids of scenes, those
        of all but the first name their log.
        """
        logs = self.log_names()
        taken: set[str] = set()
        with closing(self._rows_of_logs(logs, most)) as rows_of_logs:
            bar = Bar(
                rows_of_logs,
                desc="building scenes",
                total=len(logs),
                unit="log",
            )
            for log, rows in zip(logs, bar, strict=False):
                yield from _told_apart(log, rows, taken)

    def _rows_of_logs(self, logs: list[str], most: int | None) -> Generator[list[Row]]:
        """Yields what each log makes; most: see `rows`."""
        if min(self.workers, len(logs)) <= 1 or (most is not None and most <= FEW):
            yield from map(self._rows_of, logs)
            return
        # the workers need the script that defines the class
        in_script = type(self).__module__ == "__main__"
        coming = iter(logs)
        waiting: deque[Future[list[Row]]] = deque()
        try:
            with worker_pool(self.workers, "spawn") as pool:
                for _ in logs:
                    script = nullcontext() if in_script else without_main()
                    with interrupts_held(), script:
                        ahead = islice(coming, AHEAD * self.workers - len(waiting))
                        waiting.extend(pool.submit(self._rows_of, log) for log in ahead)
                    yield waiting.popleft().result()
        except BrokenProcessPool as error:
            raise InputError(
                f"data.workers={self.workers}: a process that builds scenes was killed, "
                "perhaps for lack of memory, or did not start, as in a script without "
                '`if __name__ == "__main__":`; set data.workers=1'
            ) from error

    def _built(self, most: int | None, index: Index) -> Iterator[dict[str, np.ndarray]]:
        """Yields the scenes of all logs, or the first `most`, when they are in the
        index.

        Raises InputError for an invalid one, unless `skip_invalid`, and where there is
        none.
        """
        index.split = self.split_name
        with closing(self.rows(most)) as rows:  # the progress bar ends before a message
            for row in rows:
                if row.scene is not None:
                    index.dataset = index.dataset or row.dataset
                    index.add(row.scene_id, row.location, row.scene)
                    yield row.scene
                    if len(index.scene_id) == most:
                        break
                elif row.usual:
                    index.dropped[row.reason] += 1
                elif self.skip_invalid:
                    index.dropped["invalid"] += 1
                    tqdm.write(f"left out {row.scene_id}: {row.reason}", sys.stderr)
                else:
                    raise InputError(
                        f"{row.reason} (data.skip_invalid=true leaves such scenes out)"
                    )
        if not index.scene_id:
            dropped = index.dropped.items()
            left_out = ", ".join(f"{count} {reason}" for reason, count in dropped)
            raise InputError(
                f"no valid scene in {self.path or f'split {self.split_name}'} "
                f"({left_out}); see the messages above, or pass other data"
            )


def load_scenes(
    data: Mapping | Source,
    num_scenes: int | None = None,
    split: str | None = None,
    starts: list[int] | None = None,
    scenes: str | Path | None = None,
    files: str = "",
) -> SceneSet:
    """Returns the scenes of a source.

    Args:
        data: the source, or a `data` group (conf/data/*.yaml) that names one.
        num_scenes: how many scenes at most.
        split: overrides the source's own where `Source.has_splits`.
        starts: overrides the source's start frames.
        scenes: a list (e2rl/scenes/scene_list.py), of which all or the first
            `num_scenes` are taken.
        files: see `listed_scenes`.

    Raises:
        InputError: a source that cannot be built, a missing or empty path, a scene of
            the list that is not there and, unless data.skip_invalid, an invalid scene.
    """
    if num_scenes is not None:
        check_range("num_scenes", num_scenes, low=1)
    source = data if isinstance(data, Source) else source_of(data)
    if split and source.has_splits:
        source = replace(source, split=split)
    if starts is not None:
        source = replace(source, starts=tuple(starts))
    if scenes is not None:
        return listed_scenes(
            scenes,
            source.load,
            most=num_scenes,
            files=files,
        )
    return source.load(num_scenes)


def source_of(data: Mapping) -> Source:
    """Returns the source that the `_target_` of a `data` group names, with the other
    keys as its settings."""
    settings = dict(data)
    target = str(settings.pop("_target_", None))
    try:
        kind = get_class(target)
    except Exception as error:  # importing a module raises anything
        raise InputError(
            f"data={target}: cannot be built: {error.__cause__ or error}; "
            "name a subclass of Source as _target_"
        ) from error
    if not issubclass(kind, Source):
        raise InputError(
            f"data={target}: is no e2rl.scenes.source.Source; "
            "subclass it, and define logs() and read()"
        )
    return settings_of(kind, settings, where="data")


def open_source(path: Path, data: str | None, workers: int) -> tuple[str, Source]:
    """Returns the data group that reads `path`, and its source; raises InputError where
    none does."""
    refusals = []
    for name in [data] if data else OF_PATHS:
        source = source_of(
            {**load_choice("data", name), "path": str(path), "workers": workers}
        )
        try:
            source.logs()
        except InputError as error:
            refusals.append(str(error))
        else:
            return name, source
    raise InputError("; ".join(dict.fromkeys(refusals)))


def _told_apart(
    log: str,
    rows: list[Row],
    taken: set[str],
) -> Iterator[Row]:
    """Yields the rows of a log with ids that no earlier scene has: ID:FILE or
    ID:FILE@START where theirs are `taken`, to which they are added."""
    file = Path(log)
    scene_ids = [row.scene_id for row in rows if row.scene is not None]
    mark = "" if taken.isdisjoint(scene_ids) else f":{file.stem}"
    for row in rows:
        if row.scene is not None:
            numbered = (f"{mark}:{number}" for number in count(2))
            for suffix in chain([mark, f":{file.with_suffix('')}"], numbered):
                scene_id = _marked(row.scene_id, suffix)
                printable = scene_id.isprintable() and len(scene_id) <= MAX_NAME
                if printable and scene_id not in taken:
                    break
            taken.add(scene_id)
            row = row._replace(scene_id=scene_id)
        yield row


def _marked(scene_id: str, mark: str) -> str:
    """Returns the id of a scene with a mark behind that of its log, before the start
    frame of a window."""
    name, at, start = scene_id.rpartition("@")
    return f"{name}{mark}{at}{start}" if at else f"{scene_id}{mark}"


def _naming(log: str, error: InputError) -> str:
    """Returns an error's message, with the log that it is about."""
    return str(error) if str(error).startswith(log) else f"{log}: {error}"
