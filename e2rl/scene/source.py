"""From the `data` config group to a SceneSet: parallel parsing, a cache keyed by content, invalid scenes counted."""

import hashlib
import json
import multiprocessing
import os
import sys
from collections import Counter
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict import TensorDict
from tqdm import tqdm

from e2rl.errors import InputError
from e2rl.scene import bundled, procedural, scenarionet
from e2rl.scene.build import BuildSettings, build_scene, ego_overlaps
from e2rl.scene.recording import Recording
from e2rl.scene.scene import SceneSet, stack, validate
from e2rl.settings import settings_of

OVERLAP, TOO_SHORT = "ego overlaps a vehicle at the start", "too short for a start frame"  # why scenes are dropped
VERSION = 3  # of the scene builder: raise it when the same recording would make another scene


def load_scenes(
    data, num_scenes: int | None = None, split: str | None = None, starts: list[int] | None = None
) -> SceneSet:
    """The scenes that a `data` config names (conf/data/*.yaml), at most `num_scenes` of them.

    split: overrides data.split for the bundled and procedural sources. starts: several scenes a log, one from each of
    these start frames; default: the log's own start frame, or data.starts. Raises InputError for a missing or empty
    path and, unless data.skip_invalid, for the first invalid scene.
    """
    settings = settings_of(BuildSettings, data.build, "data.build")
    if num_scenes is not None and num_scenes < 1:
        raise InputError(f"num_scenes={num_scenes}: expected at least 1, or null for all")
    split = split or data.split
    if data.source == "scenarionet":
        if not data.path:
            raise InputError("data.path is not set; pass data.path=FOLDER_OR_ZIP of ScenarioDescription pickles")
        scenes = _scenarionet(data, settings, starts)
    elif data.source == "bundled":
        scenes = _cached(
            _fingerprint(bundled.asset_bytes(split), settings, starts),
            data,
            lambda: _build_all(_from_starts(bundled.load_recordings(split), starts), settings, data, "bundled", split),
        )
    elif data.source == "procedural":
        recordings = procedural.generate_recordings(data.count, data.seed, split)
        scenes = _build_all(_from_starts(recordings, starts), settings, data, "procedural", split)
    else:
        raise InputError(f"data.source={data.source}: expected bundled, procedural or scenarionet")
    return scenes.first(num_scenes)


def _fingerprint(content: bytes, settings: BuildSettings, extra) -> str:
    head = json.dumps([VERSION, asdict(settings), extra], sort_keys=True)
    return hashlib.sha256(head.encode() + content).hexdigest()[:24]


def _from_starts(recordings: list[Recording], starts: list[int] | None) -> list[Recording]:
    if starts is None:
        return recordings
    return [
        replace(recording, current=start, scene_id=f"{recording.scene_id}@{start}")
        for recording in recordings
        for start in starts
    ]


def _scenarionet(data, settings: BuildSettings, starts: list[int] | None) -> SceneSet:
    files = scenarionet.list_files(data.path)
    starts = list(data.starts) if starts is None and data.starts else starts
    digest = hashlib.sha256()
    for path in sorted(
        {container if Path(container).is_file() else os.path.join(container, member) for container, member in files}
    ):
        digest.update(Path(path).read_bytes())
    locations = scenarionet.read_locations(data.path)
    split = data.split or Path(data.path).stem
    extra = [starts, bool(data.skip_invalid), sorted(locations.items()), split]
    key = _fingerprint(digest.digest(), settings, extra)

    def build() -> SceneSet:
        tasks = [(c, m, locations.get(Path(m).stem, ""), starts, settings) for c, m in files]
        return _assemble(_in_parallel(_read_file, tasks, data.workers), data, None, split)

    return _cached(key, data, build)


def _in_parallel(work, tasks: list, workers: int) -> Generator[tuple]:
    """The rows of all tasks, worked off by several processes (by this one where there is work for one only)."""
    show = partial(tqdm, desc="building scenes", total=len(tasks), unit="log")
    if min(workers, len(tasks)) <= 1:
        yield from (row for rows in show(map(work, tasks)) for row in rows)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), torch.set_num_threads, (1,)) as pool:
        try:
            yield from (row for rows in show(pool.map(work, tasks, chunksize=4)) for row in rows)
        finally:  # whoever stops at an invalid scene does not wait for the others
            pool.shutdown(wait=False, cancel_futures=True)


def _read_file(task) -> list[tuple]:
    """Rows (scene or None, id, location, dataset, reason it was left out) of one scenario file."""
    container, member, location, starts, settings = task
    try:
        content = scenarionet.read_bytes(container, member)
        recordings = list(scenarionet.read_recordings(content, member, location, starts, settings.steps))
    except InputError as error:
        return [(None, member, location, "", str(error))]
    rows = [_build_row(recording, settings, f"{member}: ") for recording in recordings]
    return rows or [(None, member, location, "", TOO_SHORT)]


def _build_recording(task) -> list[tuple]:
    """The row of one (recording, settings)."""
    return [_build_row(*task)]


def _tensors(scene: dict) -> TensorDict:
    return TensorDict({key: torch.from_numpy(value) for key, value in scene.items()}, batch_size=[])


def _build_row(recording: Recording, settings: BuildSettings, file: str = "") -> tuple:
    name = (recording.scene_id, recording.location, recording.dataset)
    try:
        scene = build_scene(recording, settings)
        validate(scene, recording.scene_id)
    except InputError as error:
        return (None, *name, f"{file}{error}")
    if ego_overlaps(scene):
        return (None, *name, OVERLAP)
    # Plain arrays cross the process border; tensors would each hold a shared-memory file open.
    return ({key: value.numpy() for key, value in scene.items()}, *name, None)


def _build_all(recordings, settings: BuildSettings, data, dataset: str, split: str) -> SceneSet:
    tasks = [(recording, settings) for recording in recordings]
    return _assemble(_in_parallel(_build_recording, tasks, data.workers), data, dataset, split)


def _assemble(rows: Generator[tuple], data, dataset: str | None, split: str) -> SceneSet:
    """Stack the good rows; raise the first invalid one's message unless data.skip_invalid."""
    dropped, good = Counter(), []
    with closing(rows):  # the bar ends before a message
        for scene, name, location, source, reason in rows:
            if scene is not None:
                good.append((scene, name, location, source))
            elif reason in (OVERLAP, TOO_SHORT):
                dropped[reason] += 1
            elif data.skip_invalid:
                dropped["invalid"] += 1
                tqdm.write(f"left out {name}: {reason}", sys.stderr)
            else:
                raise InputError(f"{reason} (data.skip_invalid=true leaves such scenes out)")
    if not good:
        left_out = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
        raise InputError(
            f"no valid scene in {data.get('path') or f'{dataset} {split}'} ({left_out}); see the messages "
            "above, or pass other data"
        )
    scenes, names, locations, sources = zip(*good, strict=True)
    return SceneSet(
        stack([_tensors(scene) for scene in scenes]),
        list(names),
        list(locations),
        dataset or sources[0],
        split,
        dict(dropped),
    )


def _cached(key: str, data, build) -> SceneSet:
    """The SceneSet under a key of the cache folder, built and stored (atomically) where it is not there."""
    path = Path(data.cache) / f"scenes-{key}.safetensors"
    if path.exists():
        try:
            return _load(path)
        except (SafetensorError, KeyError, ValueError, TypeError, OSError) as error:
            tqdm.write(f"rebuilding the damaged cache file {path}: {error}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"data.cache={data.cache}: cannot be made ({error}); pass a writable folder") from error
    scenes = build()
    names = {
        "scene_id": scenes.scene_id,
        "location": scenes.location,
        "dataset": scenes.dataset,
        "split": scenes.split,
        "dropped": scenes.dropped,
    }
    part = path.with_suffix(f".{os.getpid()}.part")
    try:
        save_file(
            {key: value.contiguous() for key, value in scenes.scenes.items()},
            part,
            metadata={"scenes": json.dumps(names)},
        )
        part.replace(path)
    except OSError as error:
        raise InputError(
            f"data.cache={data.cache}: cannot be written ({error}); free space, or pass another folder"
        ) from error
    finally:
        part.unlink(missing_ok=True)
    return scenes


def _load(path: Path) -> SceneSet:
    with safe_open(path, "pt") as file:
        names = json.loads(file.metadata()["scenes"])
        columns = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
    return SceneSet(TensorDict(columns, batch_size=[len(names["scene_id"])]), **names)
