"""A data source: CSV files of tracks (frame, track, x, y, heading, speed) on a straight
road of parallel lanes."""

import io
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from e2rl.run.errors import InputError
from e2rl.scenes.log_files import LogFiles
from e2rl.scenes.recording import Lane, Recording

COLUMNS = ["frame", "track", "x", "y", "heading", "speed"]


@dataclass
class CsvTracks(LogFiles):
    """Each *.csv below `path` is a log at 10 Hz; its first track is the ego. All tracks
    are cars of one size."""

    lanes: int = 2
    lane_width: float = 3.5

    holds, ending = "csv files", ".csv"

    def read(self, log: str) -> Iterator[Recording]:
        """The one recording of a file."""
        table = np.atleast_1d(
            np.genfromtxt(io.BytesIO(self.content(log)), delimiter=",", names=True)
        )
        if list(table.dtype.names or ()) != COLUMNS:
            raise InputError(
                f"{log}: expected the columns {', '.join(COLUMNS)}, found {table.dtype.names}"
            )
        frame = table["frame"].astype(int)
        track = table["track"].astype(int)
        states = np.zeros((frame.max() + 1, track.max() + 1, 4))
        valid = np.zeros(states.shape[:2], bool)
        states[frame, track] = np.stack([table[name] for name in COLUMNS[2:]], -1)
        valid[frame, track] = True
        size = np.tile([4.6, 1.9], (states.shape[1], 1))
        yield Recording(
            log,
            "road",
            "csv",
            states,
            valid,
            size,
            np.zeros(len(size), int),
            0,
            self.road(),
        )

    def road(self) -> dict[str, Lane]:
        """Parallel lanes, the first on the right."""
        ends = np.array([-200.0, 800.0])
        lines = [
            np.stack([ends, np.full(2, k * self.lane_width)], -1)
            for k in range(self.lanes)
        ]
        road = {
            str(k): Lane(line, self.lane_width, speed_limit=20.0)
            for k, line in enumerate(lines)
        }
        for k in range(self.lanes - 1):
            road[str(k)].left.append(str(k + 1)), road[str(k + 1)].right.append(str(k))
        return road
