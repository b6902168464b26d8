"""A data source: CSV files of tracks (frame, track, x, y, heading, speed) on a straight road of parallel lanes."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from e2rl.run.errors import InputError
from e2rl.run.files import hash_files
from e2rl.scenes.recording import Lane, Recording
from e2rl.scenes.source import Source

COLUMNS = ["frame", "track", "x", "y", "heading", "speed"]


@dataclass
class CsvTracks(Source):
    """Each *.csv below `path` is a log at 10 Hz; its first track is the ego. All tracks are cars of one size."""

    lanes: int = 2
    lane_width: float = 3.5

    holds = "csv files"

    def logs(self) -> list[str]:
        """Their names."""
        return sorted(file.name for file in self.root().glob("*.csv"))

    def read(self, log: str) -> Iterator[Recording]:
        """The one recording of a file."""
        table = np.atleast_1d(np.genfromtxt(self.root() / log, delimiter=",", names=True))
        if list(table.dtype.names or ()) != COLUMNS:
            raise InputError(f"{log}: expected the columns {', '.join(COLUMNS)}, found {table.dtype.names}")
        frame, track = table["frame"].astype(int), table["track"].astype(int)
        states = np.zeros((frame.max() + 1, track.max() + 1, 4))
        valid = np.zeros(states.shape[:2], bool)
        states[frame, track] = np.stack([table[name] for name in COLUMNS[2:]], -1)
        valid[frame, track] = True
        agents, ends = states.shape[1], np.array([-200.0, 800.0])
        road = {
            str(k): Lane(np.stack([ends, np.full(2, k * self.lane_width)], -1), self.lane_width, speed_limit=20.0)
            for k in range(self.lanes)
        }
        for k in range(self.lanes - 1):
            road[str(k)].left.append(str(k + 1)), road[str(k + 1)].right.append(str(k))
        size = np.tile([4.6, 1.9], (agents, 1))
        yield Recording(log, "road", "csv", states, valid, size, np.zeros(agents, int), 0, road)

    def fingerprint(self) -> bytes:
        """Changes with the files' names and contents."""
        return hash_files(sorted(self.root().glob("*.csv")))
