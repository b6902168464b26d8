"""What a source yields: one recorded (or generated) piece of traffic with its map, on the host, in numpy."""

from dataclasses import dataclass, field

import numpy as np

from e2rl.errors import InputError

VEHICLE, PEDESTRIAN, CYCLIST, OTHER = range(4)
AGENT_TYPES = ("vehicle", "pedestrian", "cyclist", "other")
LIGHT_UNKNOWN, LIGHT_RED, LIGHT_YELLOW, LIGHT_GREEN = range(4)
DT = 0.1  # s, the time step of every recording, scene and simulation


@dataclass
class Lane:
    """One lane's centreline, in driving direction.

    points [P, 2] m; width m (0 or NaN: unknown); speed_limit m/s (0: unknown); exits, left, right: ids of successor and
    neighbour lanes; heights [P] m or None (tells the levels of bridges apart where connectivity is inferred).
    """

    points: np.ndarray
    width: float = 0.0
    speed_limit: float = 0.0
    exits: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    right: list[str] = field(default_factory=list)
    heights: np.ndarray | None = None


@dataclass
class Recording:
    """Tracks and map of one log at 10 Hz.

    states [F, A, 4]: x, y [m], heading [rad], speed [m/s]; valid [F, A]; size [A, 2]: length, width [m];
    agent_type [A]; ego: index of the ego's track; lights: lane id -> [F] light state; drivable: polygons [P, 2];
    current: the start frame, with at least one frame of history before it.
    """

    scene_id: str
    location: str
    dataset: str
    states: np.ndarray
    valid: np.ndarray
    size: np.ndarray
    agent_type: np.ndarray
    ego: int
    lanes: dict[str, Lane]
    drivable: list[np.ndarray] = field(default_factory=list)
    lights: dict[str, np.ndarray] = field(default_factory=dict)
    current: int = 10

    def validate(self) -> "Recording":
        """Return self; raise InputError naming the scene where tracks, ego or lanes cannot make a scene."""
        where = f"scene {self.scene_id!r}"
        frames, agents = self.valid.shape if self.valid.ndim == 2 else (0, 0)
        if self.states.shape != (frames, agents, 4) or not frames or not agents:
            raise InputError(
                f"{where}: states {self.states.shape} do not match valid {self.valid.shape}; expected "
                "[frames, agents, 4] and [frames, agents]"
            )
        if not 0 <= self.ego < agents:
            raise InputError(f"{where}: no ego; name its track in metadata.sdc_id, or leave the scene out")
        if not self.lanes:
            raise InputError(f"{where}: no lanes; routes need lane centrelines, so leave the scene out")
        if not 1 <= self.current < frames - 1:
            raise InputError(f"{where}: start frame {self.current} leaves no history or no future in {frames} frames")
        if not self.valid[self.current, self.ego]:
            raise InputError(f"{where}: the ego is not recorded at the start frame {self.current}")
        if self.agent_type[self.ego] != VEHICLE:
            raise InputError(
                f"{where}: the ego is a {AGENT_TYPES[self.agent_type[self.ego]]}, expected a vehicle; "
                "name another track in metadata.sdc_id, or leave the scene out"
            )
        for name, lane in self.lanes.items():
            if lane.points.ndim != 2 or lane.points.shape[1] != 2 or not np.isfinite(lane.points).all():
                raise InputError(
                    f"{where}: the centreline of lane {name} is not a list of finite points; repair the "
                    "map or leave the lane out"
                )
        if not all(np.isfinite(ring).all() for ring in self.drivable):
            raise InputError(f"{where}: a drivable polygon holds NaN or infinite points; repair the map")
        if not np.isfinite(self.states[self.valid]).all():
            frame, agent = np.argwhere(self.valid & ~np.isfinite(self.states).all(-1))[0]
            raise InputError(
                f"{where}: NaN or infinite state of agent {agent} at frame {frame}, marked valid; mark it "
                "invalid or repair the log"
            )
        used = self.valid.any(0)
        if not (np.isfinite(self.size[used]).all() and (self.size[used] > 0).all()):
            raise InputError(f"{where}: an agent's length or width is not positive; repair the log")
        return self
