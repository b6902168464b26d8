"""The scenes of a run's rollouts, made again from the data that its configuration names."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from e2rl.evaluation.resume import check_code
from e2rl.report.export.episode import Episode, recorded_episode, rollout_episode
from e2rl.run.errors import InputError
from e2rl.scenes.recording import Recording
from e2rl.scenes.source import Source, source_of

WITHOUT = "or pass --no-scene, for the lanes of the rollout files alone"


def episodes_of(run: Path, rows: Sequence[Mapping], plugins: Sequence[str], scene: bool) -> Iterator[Episode]:
    """The episodes of rows of rollouts.csv, scene by scene; scene=False: of the rollout files alone."""
    if not scene:
        yield from (rollout_episode(run, row) for row in rows)
        return
    waiting: dict[str, list[Mapping]] = defaultdict(list)
    for row in rows:
        waiting[row["scene_id"]].append(row)
    source = source_of_run(run, rows[0]["split"], plugins)
    for recording in recordings(source, list(waiting)):
        for row in waiting.pop(recording.scene_id, ()):
            yield recorded_episode(run, row, recording, source.build)
        if not waiting:
            return
    raise InputError(f"{run}: the data of the run hold no scene {next(iter(waiting))!r} now; restore them, {WITHOUT}")


def source_of_run(run: Path, split: str, plugins: Sequence[str]) -> Source:
    """The source that a run's configuration names, on `split`. The folder may be a stranger's: code of others takes
    part only where `plugins` names its modules."""
    folder = next((folder for folder in (run, run.parent) if (folder / ".hydra" / "config.yaml").is_file()), None)
    if folder is None:
        raise InputError(f"{run}: no .hydra/config.yaml says where its scenes come from; restore it, {WITHOUT}")
    file = folder / ".hydra" / "config.yaml"
    try:
        data = OmegaConf.select(OmegaConf.load(file), "data")
        where = OmegaConf.select(OmegaConf.load(file.with_name("hydra.yaml")), "hydra.runtime.cwd")
        check_code(OmegaConf.create({"data": data}), list(plugins), f"{run} (pass --plugin MODULE for plugins=)")
        plain = OmegaConf.to_container(data, resolve=True) if isinstance(data, DictConfig) else None
    except (OSError, KeyError, TypeError, ValueError, RecursionError, YAMLError, OmegaConfBaseException) as error:
        if isinstance(error, InputError):
            raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{file}: damaged ({reason}); restore it, {WITHOUT}") from error
    if not isinstance(plain, dict):
        raise InputError(f"{file}: its `data` is no group of settings; restore it, {WITHOUT}")
    for name in plugins:
        try:
            import_module(name)
        except ImportError as error:
            raise InputError(f"--plugin {name}: {error}; install it or put its folder on PYTHONPATH") from error
    if plain.get("path") and where:
        plain["path"] = str(Path(where) / str(plain["path"]))  # an absolute path stays as it is
    source = source_of({str(key): value for key, value in plain.items()})
    return replace(source, split=split) if source.has_splits else source


def recordings(source: Source, wanted: Sequence[str]) -> Iterator[Recording]:
    """The recordings with the `wanted` ids, those first whose log's name tells the id."""
    names = {name.rsplit("@", 1)[0] for name in wanted}
    for log in sorted(source.logs(), key=lambda log: not any(name in log for name in names)):
        try:
            for read in source.read(log):
                windows = read.windows(source.starts, source.build.steps)
                yield from (recording for recording in windows if recording.scene_id in wanted)
        except InputError:
            if not source.skip_invalid:
                raise
