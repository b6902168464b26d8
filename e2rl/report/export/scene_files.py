"""The scenes of a run's rollouts, made again from the data that its configuration
names."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from e2rl.report.export.episode import Episode, recorded_episode, rollout_episode
from e2rl.run.config import import_plugins, resolved
from e2rl.run.errors import InputError
from e2rl.run.run import PROVENANCE, read_provenance
from e2rl.run.trust import CONFIG, check_code, read_yaml
from e2rl.scenes.recording import Recording
from e2rl.scenes.source import Source, source_of

WITHOUT = "or pass --no-scene, for the lanes of the rollout files alone"


def episodes_of(
    run: Path,
    rows: Sequence[Mapping],
    plugins: Sequence[str],
    scene: bool,
) -> Iterator[Episode]:
    """The episodes of rows of rollouts.csv, scene by scene; scene=False: of the rollout
    files alone."""
    if not scene:
        yield from (rollout_episode(run, row) for row in rows)
        return
    waiting: dict[str, list[Mapping]] = defaultdict(list)
    for row in rows:
        waiting[row["scene_id"]].append(row)
    source = source_of_run(run, rows[0]["split"], plugins=plugins)
    for recording in recordings(source, list(waiting)):
        for row in waiting.pop(recording.scene_id, ()):
            yield recorded_episode(run, row, recording=recording, build=source.build)
        if not waiting:
            return
    raise InputError(
        f"{run}: the data of the run hold no scene {next(iter(waiting))!r} now; restore "
        f"them, {WITHOUT}"
    )


def source_of_run(run: Path, split: str, plugins: Sequence[str]) -> Source:
    """The source that a run's configuration names, on `split`. The folder may be a
    stranger's: code of others takes part only where `plugins` names its modules."""
    folder = next(
        (
            folder
            for folder in (run, *run.resolve().parents[:2])
            if (folder / CONFIG).is_file()
        ),
        None,
    )
    if folder is None:
        raise InputError(
            f"{run}: no {CONFIG} says where its scenes come from; restore it, {WITHOUT}"
        )
    config = read_yaml(folder / CONFIG)
    try:
        data = OmegaConf.create({"data": OmegaConf.select(config, "data")})
        check_code(data, plugins, where=f"{run} (pass --plugin MODULE for plugins=)")
        plain = resolved(data)["data"]
    except OmegaConfBaseException as error:
        raise InputError(
            f"{folder / CONFIG}: damaged ({str(error).splitlines()[0]}); restore it, {WITHOUT}"
        ) from error
    if not isinstance(plain, dict):
        raise InputError(
            f"{folder / CONFIG}: its `data` is no group of settings; restore it, {WITHOUT}"
        )
    import_plugins(plugins, "--plugin ")
    if (
        plain.get("path") and (folder / PROVENANCE).is_file()
    ):  # an absolute path stays as it is
        plain["path"] = str(Path(read_provenance(folder)["cwd"]) / str(plain["path"]))
    source = source_of({str(key): value for key, value in plain.items()})
    return replace(source, split=split) if source.has_splits else source


def recordings(source: Source, wanted: Sequence[str]) -> Iterator[Recording]:
    """The recordings with these ids, those first whose log's name tells the id."""
    names = {name.rsplit("@", 1)[0] for name in wanted}
    for log in sorted(
        source.logs(), key=lambda log: not any(name in log for name in names)
    ):
        try:
            for read in source.read(log):
                windows = read.windows(source.starts, source.build.steps)
                yield from (
                    recording for recording in windows if recording.scene_id in wanted
                )
        except InputError:
            if not source.skip_invalid:
                raise
