"""What a source yields: one recorded or generated piece of traffic with its map, on the
host, in numpy."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from e2rl.run.errors import InputError

VEHICLE, PEDESTRIAN, CYCLIST, OTHER = range(4)
AGENT_TYPES = ("vehicle", "pedestrian", "cyclist", "other")
AGENT_WORDS = ("a vehicle", "a pedestrian", "a cyclist", "an object")  # in sentences
LIGHT_UNKNOWN, LIGHT_RED, LIGHT_YELLOW, LIGHT_GREEN = range(4)
COLOURS = {  # by the words in the names of logs; of several, such as "red yellow", the first here
    **dict.fromkeys(("RED", "REDYELLOW", "STOP"), LIGHT_RED),
    **dict.fromkeys(("YELLOW", "AMBER", "CAUTION"), LIGHT_YELLOW),
    **dict.fromkeys(("GREEN", "GO"), LIGHT_GREEN),
}
NO_SIGNAL = {
    "FLASHING",
    "BLINKING",
    "OFF",
    "INACTIVE",
}  # words of lights that let nobody wait for another colour
DT = 0.1  # s, the time step of every recording, scene and simulation
HIDDEN = 5  # steps of absence, at most, of an agent that is merely out of sight; after more it appears anew
HISTORY = 10  # frames of history before a start frame that is chosen here
MOVED_START = "start frames moved to where enough past and future are recorded"
MAX_NAME = 128  # characters of the name of a scene, a place or a data set


@dataclass
class Lane:
    """One lane's centreline, in driving direction.

    points [P, 2] m; width m (0 or NaN: unknown); speed_limit m/s (0: unknown); exits,
    left, right: ids of successor and neighbour lanes; heights [P] m or None (tells the
    levels of bridges apart).
    """

    points: np.ndarray
    width: float = 0.0
    speed_limit: float = 0.0
    exits: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    right: list[str] = field(default_factory=list)
    heights: np.ndarray | None = None


def light_colour(name: object, otherwise: int = LIGHT_UNKNOWN) -> int:
    """Returns the state of a light that a log calls `name`, `otherwise` where that
    tells none.

    LANE_STATE_ARROW_STOP, TRAFFIC_LIGHT_RED and redYellow are red. A light that flashes
    or is off is LIGHT_UNKNOWN: yellow means care and red a stop sign there, and neither
    turns green.
    """
    words = set(str(name).upper().replace("-", "_").replace(" ", "_").split("_"))
    if words & NO_SIGNAL:
        return LIGHT_UNKNOWN
    return next((state for word, state in COLOURS.items() if word in words), otherwise)


NUMBERS = "fiu"  # kinds of arrays
ARRAYS = (  # fields of a Recording: name, kinds of numbers, columns, in words
    ("states", "f", 4, "a float array [frames, agents, 4]"),
    ("size", NUMBERS, 2, "an array [agents, 2] of lengths and widths"),
    ("agent_type", "iu", 0, "an integer array [agents]"),
)
FIELDS: tuple[tuple[str, Any, str], ...] = (  # further ones: name, classes, in words
    ("ego", int | np.integer, "the index of a track"),
    ("current", int | np.integer | None, "a frame, or None"),
    ("lanes", Mapping, "a dict of Lane objects"),
    ("lights", Mapping, "a dict of arrays"),
    ("drivable", list | tuple, "a list of arrays"),
    ("repairs", Mapping, "a Counter"),
    ("egos", Mapping, "a dict of frames and tracks"),
    ("heights", np.ndarray | None, "an array [frames, agents], or None"),
    ("towed", list | tuple, "a tuple of tracks"),
    ("coupled", list | tuple, "a tuple of tracks"),
)
FEW_FRAMES = "fewer than two frames of different time stamps; leave it out"


def same_way(lanes: Mapping[str, Lane], lane: Lane, neighbour: object) -> list[str]:
    """Returns the id of a lane's neighbour, if it is one of `lanes` and no oncoming
    one, which maps name as well."""
    other = lanes.get(str(neighbour))
    if other is None:
        return []
    same = (
        np.dot(lane.points[-1] - lane.points[0], other.points[-1] - other.points[0]) > 0
    )
    return [str(neighbour)] if same else []


@dataclass
class Recording:
    """Tracks and map of one log at 10 Hz.

    states [F, A, 4]: x, y [m], heading [rad], speed [m/s]; valid [F, A]; size [A, 2]:
    length, width [m]; agent_type [A]; ego: index of the ego's track; lights: lane id ->
    [F] light state; drivable: polygons [P, 2]; current: the start frame, with at least
    one frame of history before it; None where the log names none; egos: the ego's track
    by start frame, where it is not the same for all (-1: nobody is there); heights [F,
    A] m (NaN: unknown) or None: of the tracks, which tell who is on a bridge
    (e2rl/scenes/levels.py); towed: tracks of trailers that nobody drives, but a replay
    shows; coupled: of vehicles with their trailers; repairs: how often reading mended
    something, by a phrase in the plural, such as "headings turned round".
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
    current: int | None = HISTORY
    repairs: Counter[str] = field(default_factory=Counter)
    egos: dict[int, int] = field(default_factory=dict)
    heights: np.ndarray | None = None
    towed: tuple[int, ...] = ()
    coupled: tuple[int, ...] = ()

    def all_egos(self) -> list[int]:
        """Returns the tracks that are the ego's at any start frame."""
        return sorted({self.ego, *self.egos.values()} - {-1})

    def start_frames(self, starts: Sequence[int] | None, steps: int) -> list[int]:
        """Returns the start frames of `windows`; none where the log is too short for
        them.

        Args:
            starts: those that are asked for, of which each must leave half of the steps
                recorded; None: the log's own,
                or, where it names none, as many as fit one after another (at least one).
            steps: simulated steps of a scene.
        """
        frames = len(self.states)
        if starts:
            return [start for start in starts if start <= frames - steps // 2]
        if self.current is not None:
            return [self._own_start(steps)]
        return list(range(HISTORY, frames - steps, steps + HISTORY + 1)) or [HISTORY]

    def windows(
        self, starts: Sequence[int] | None, steps: int
    ) -> Iterator["Recording"]:
        """Yields the recordings of `steps` simulated steps that this log makes.

        Those of several, or of `starts`, have ids of the form `id@start`. A start frame
        of the log's own that leaves too little past or future is moved, which counts as
        a repair.

        Args:
            starts, steps: see `start_frames`.
        """
        frames = self.start_frames(starts, steps)
        repairs = Counter(self.repairs)
        repairs[MOVED_START] += (
            not starts and self.current is not None and frames != [self.current]
        )
        for start in frames:
            name = (
                f"{self.scene_id}@{start}"
                if starts or len(frames) > 1
                else self.scene_id
            )
            ego = self.egos.get(start, self.ego)
            yield replace(self, current=start, scene_id=name, ego=ego, repairs=+repairs)

    def _own_start(self, steps: int) -> int:
        """Returns the log's own start frame, or the first with enough past and future
        where it has not.

        Enough are HISTORY frames with the ego before it, and half of the steps after
        it.
        """
        assert self.current is not None
        last = len(self.states) - steps // 2
        if HISTORY <= self.current <= last or not 0 <= self.ego < self.valid.shape[1]:
            return self.current
        absent = np.cumsum(~self.valid[:, self.ego])
        before = np.concatenate([np.zeros(HISTORY + 1, int), absent])[: len(absent)]
        enough = np.flatnonzero((absent == before)[: last + 1])
        enough = enough[enough >= HISTORY]
        return int(enough[0]) if len(enough) else self.current

    def has_ego(self) -> bool:
        """Returns whether the ego is recorded at the start frame."""
        return 0 <= self.ego < self.valid.shape[1] and bool(
            self.valid[self.current, self.ego]
        )

    def validate_names(self) -> "Recording":
        """Returns self; raises InputError for a name that is no short text: files,
        tables and messages hold it."""
        for what in ("scene_id", "location", "dataset"):
            name = getattr(self, what)
            if (
                not isinstance(name, str)
                or not name.isprintable()
                or len(name) > MAX_NAME
            ):
                raise InputError(
                    f"its {what} {ascii(name)[:60]} is no line of {MAX_NAME} printable characters; rename it"
                )
        if not self.scene_id:
            raise InputError("it has no id; give it one")
        return self

    def validate_fields(self) -> "Recording":
        """Returns self; raises InputError naming the scene and a field that is of
        another kind, type or shape."""
        frames, agents = (
            self.valid.shape
            if isinstance(self.valid, np.ndarray) and self.valid.ndim == 2
            else (-1, -1)
        )
        shape = f"{frames} frames, {agents} agents"
        if agents < 0 or self.valid.dtype != bool:
            raise self._wrong(
                "valid", self.valid, expected="a bool array [frames, agents]"
            )
        for name, kinds, columns, text in ARRAYS:
            value = getattr(self, name)
            sizes = (
                (frames, agents, columns)
                if name == "states"
                else (agents, columns)[: 1 + (columns > 0)]
            )
            if (
                not isinstance(value, np.ndarray)
                or value.dtype.kind not in kinds
                or value.shape != sizes
            ):
                raise self._wrong(
                    name, value, expected=f"{text}, as valid is of {shape}"
                )
        if not ((self.agent_type >= VEHICLE) & (self.agent_type <= OTHER)).all():
            raise self._wrong(
                "agent_type",
                self.agent_type,
                expected=f"numbers from {VEHICLE} to {OTHER}",
            )
        for name, types, text in FIELDS:
            value = getattr(self, name)
            if not isinstance(value, types) or isinstance(value, bool):
                raise self._wrong(name, value, expected=text)
        if self.heights is not None and not _are_numbers(
            self.heights, (frames, agents)
        ):
            raise self._wrong(
                "heights",
                self.heights,
                expected=f"numbers [frames, agents], as valid is of {shape}",
            )
        for name in ("towed", "coupled"):
            if not all(_is_index(track, agents) for track in getattr(self, name)):
                raise self._wrong(
                    name,
                    getattr(self, name),
                    expected=f"a tuple of tracks from 0 to {agents - 1}",
                )
        self._validate_map(frames)
        return self

    def _validate_map(self, frames: int) -> None:
        """Raises InputError for lanes, polygons and lights that are of another kind,
        type or length."""
        for name, lane in self.lanes.items():
            if not isinstance(name, str) or not isinstance(lane, Lane):
                raise self._wrong(
                    "lanes", {name: lane}, expected="a Lane by a text each"
                )
            for part in ("points", "heights"):
                value = getattr(lane, part)
                if not isinstance(value, np.ndarray) and not (
                    part == "heights" and value is None
                ):
                    raise self._wrong(
                        f"lanes[{name!r}].{part}", value, expected="an array"
                    )
            if lane.heights is not None and not _are_numbers(
                lane.heights, lane.points.shape[:1]
            ):
                count = len(lane.points) if lane.points.ndim else 0
                raise self._wrong(
                    f"lanes[{name!r}].heights",
                    lane.heights,
                    expected=f"{count} numbers, one of each point",
                )
            for part in ("width", "speed_limit"):
                if not isinstance(getattr(lane, part), int | float | np.number):
                    raise self._wrong(
                        f"lanes[{name!r}].{part}",
                        getattr(lane, part),
                        expected="a number",
                    )
            for part in ("exits", "left", "right"):
                value = getattr(lane, part)
                if not isinstance(value, list | tuple) or not all(
                    isinstance(other, str) for other in value
                ):
                    raise self._wrong(
                        f"lanes[{name!r}].{part}",
                        value,
                        expected="a list of ids of lanes, which are texts",
                    )
        for ring in self.drivable:
            if not isinstance(ring, np.ndarray):
                raise self._wrong(
                    "drivable", ring, expected="a list of arrays [points, 2]"
                )
        for name, light in self.lights.items():
            known = (
                isinstance(light, np.ndarray)
                and light.dtype.kind in "iu"
                and light.shape == (frames,)
            )
            if name not in self.lanes or not known:
                raise self._wrong(
                    f"lights[{name!r}]",
                    light,
                    expected=f"an integer array of {frames} states, by the id of a lane",
                )

    def _wrong(self, name: str, value: object, expected: str) -> InputError:
        """Returns the error of a field that is not what is expected."""
        kind = (
            f"{value.dtype} {list(value.shape)}"
            if isinstance(value, np.ndarray)
            else f"{type(value).__name__} {' '.join(ascii(value).split())[:40]}"
        )
        return InputError(
            f"scene {self.scene_id!r}: its {name} is {kind}; expected {expected}"
        )

    def validate_log(self) -> "Recording":
        """Returns self; raises InputError naming the scene where tracks, ego or lanes
        cannot make a scene."""
        if problem := self._log_problem():
            raise InputError(f"scene {self.scene_id!r}: {problem}")
        return self

    def validate_start(self) -> "Recording":
        """Returns self; raises InputError naming the scene where the start frame cannot
        be one."""
        frames = len(self.states)
        scene = f"scene {self.scene_id!r}"
        if self.current is None or not 1 <= self.current < frames - 1:
            start = f"start frame {self.current}"
            raise InputError(
                f"{scene}: {start} leaves no history or no future in {frames} frames"
            )
        if not self.valid[self.current, self.ego]:
            raise InputError(
                f"{scene}: the ego is not recorded at the start frame {self.current}"
            )
        return self

    def _log_problem(self) -> str | None:
        """Returns what is wrong with the log and how to mend it; None: nothing."""
        frames, agents = self.valid.shape if self.valid.ndim == 2 else (0, 0)
        if self.states.shape != (frames, agents, 4) or not frames or not agents:
            shapes = f"states {self.states.shape} do not match valid {self.valid.shape}"
            return f"{shapes}; expected [frames, agents, 4] and [frames, agents]"
        if frames < 2:
            return FEW_FRAMES
        if not 0 <= self.ego < agents:
            return "no ego; name its track in metadata.sdc_id, or leave the scene out"
        if not self.lanes:
            return "no lanes; routes need lane centrelines, so leave the scene out"
        if self.agent_type[self.ego] != VEHICLE:
            kind = AGENT_TYPES[self.agent_type[self.ego]]
            return f"the ego is a {kind}, expected a vehicle; name another track, or leave the scene out"
        for name, lane in self.lanes.items():
            if not _are_points(lane.points) or lane.points.shape[1] != 2:
                return f"the centreline of lane {name} is not a list of finite points; repair the map or drop the lane"
        if not all(_are_points(ring) for ring in self.drivable):
            return "a drivable polygon is not a list of finite points; repair the map"
        bad = self.valid & ~np.isfinite(self.states).all(-1)
        if bad.any():
            frame, agent = np.argwhere(bad)[0]
            return f"NaN or infinite state of agent {agent} at frame {frame}; mark it invalid or repair the log"
        size = self.size[self.valid.any(0)]
        if not (np.isfinite(size).all() and (size > 0).all()):
            return "an agent's length or width is not positive; repair the log"
        return None


def _are_numbers(values: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Returns whether an array is of numbers and of a shape."""
    return values.dtype.kind in NUMBERS and values.shape == shape


def _is_index(value: object, count: int) -> bool:
    """Returns whether a value is one of 0 .. count - 1."""
    return (
        isinstance(value, int | np.integer)
        and not isinstance(value, bool)
        and 0 <= int(value) < count
    )


def _are_points(points: np.ndarray) -> bool:
    """Whether an array is of finite points [P, 2 or more]."""
    if points.ndim != 2 or points.shape[1] < 2 or points.dtype.kind not in NUMBERS:
        return False
    return bool(np.isfinite(points).all())
