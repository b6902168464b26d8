"""Failures in the formats of other tools, inside the failure report: what its buttons
save as files."""

import base64
import io
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from e2rl.report.export.episode import Episode
from e2rl.report.export.formats import SINGLE, writer_of
from e2rl.report.export.scene_files import episodes_of


@dataclass(frozen=True)
class Attached:
    """What is attached to the failures that a page replays.

    Args:
        formats: names of FORMATS.
        scene: with what the data know of the scene, as `e2rl export` writes it; False:
            from the rollout files alone.
        plugins: modules of the data source.
    """

    formats: Sequence[str]
    scene: bool = True
    plugins: Sequence[str] = ()

    def files(self, run: Path, rows: Sequence[Mapping]) -> dict[str, list[dict]]:
        """Returns the files of each failure, by its name: `name`, `size` [bytes] and
        `data`, base64 of zlib.

        Args:
            run: the folder of the run.
            rows: of rollouts.csv.

        Raises:
            InputError: where a library, a rollout file or the data are missing.
        """
        writers = {name: writer_of(name, "--attach") for name in self.formats}
        files: dict[str, list[dict]] = {}
        if not rows:
            return files
        episodes: Iterable[Episode] = episodes_of(
            run, rows, plugins=self.plugins, scene=self.scene
        )
        for episode in tqdm(
            episodes,
            "attaching",
            total=len(rows),
            unit="rollout",
            leave=False,
            disable=None,
        ):
            files[episode.path.stem] = [
                attached_file(episode, name, write) for name, write in writers.items()
            ]
        return files


def attached_file(
    episode: Episode,
    name: str,
    write: Callable[..., Iterator[tuple[Episode, Path]]],
) -> dict[str, Any]:
    """Returns an episode's file in a format; an archive where there are several."""
    with tempfile.TemporaryDirectory() as folder:
        ((_, path),) = write([episode], Path(folder))
        if name in SINGLE:
            content = path.read_bytes()
            title = f"{episode.path.stem}{path.suffix}"
        else:
            content = archive(Path(folder))
            title = f"{episode.path.stem}.{name}.zip"
    data = base64.b64encode(zlib.compress(content, 9)).decode()
    return {"name": title, "size": len(content), "data": data}


def archive(folder: Path) -> bytes:
    """Returns an uncompressed archive of a folder's files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as zipped:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                zipped.write(path, path.relative_to(folder))
    return buffer.getvalue()
