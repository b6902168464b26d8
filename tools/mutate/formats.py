"""Recorded logs of every format that can be mutated."""

import zipfile
from importlib.util import find_spec
from pathlib import Path

from e2rl.scenes.argoverse2 import Argoverse2Source
from e2rl.scenes.commonroad import CommonRoadSource
from e2rl.scenes.log_files import LogFiles
from e2rl.scenes.scenarionet import ScenarioNetSource, safe_load
from e2rl.scenes.source import Source
from tools.mutate.argoverse2 import ScenarioLog, SensorLog
from tools.mutate.commonroad import CommonRoadLog
from tools.mutate.log import RecordedLog
from tools.mutate.scenarionet import ScenarioNetLog


def source_of(path: str) -> Source:
    """The source of the logs at a path, by their names; exits where its library is missing."""
    root = Path(path)
    if root.is_dir() and list(root.rglob("log_map_archive_*.json")):
        return _needing("av2", Argoverse2Source(path))
    kinds: tuple[type[LogFiles], ...] = (ScenarioNetSource, CommonRoadSource)
    names = [file.name for file in root.rglob("*")] if root.is_dir() else _names(root)
    kind = next((kind for kind in kinds if any(name.endswith(kind.ending) for name in names)), ScenarioNetSource)
    return _needing("commonroad", kind(path)) if kind is CommonRoadSource else kind(path)


def _needing(library: str, source: Source) -> Source:
    """The source; without its library every log would be refused."""
    if find_spec(library) is None:
        raise SystemExit(f"{source.root()}: needs {library}; install e2rl with the extra of this data")
    return source


def _names(archive: Path) -> list[str]:
    with zipfile.ZipFile(archive) as opened:
        return opened.namelist()


def opened(source: Source, log: str) -> RecordedLog:
    """A log of a source."""
    if isinstance(source, ScenarioNetSource):
        return ScenarioNetLog.of(log, safe_load(source.content(log), log))
    if isinstance(source, CommonRoadSource):
        return CommonRoadLog.of(log, source.content(log))
    path = source.root() / log
    return ScenarioLog.of(path) if path.suffix == ".parquet" else SensorLog.of(path)
