"""What a source yields: one recorded or generated piece of traffic with its map, on the
host, in numpy."""

from collections import Counter
from collections.abc import (
    Iterator,
    Mapping,
    Sequence,
)
from dataclasses import (
    dataclass,
    field,
    replace,
)
from itertools import chain
from typing import Any

import numpy as np
from numpy import ndarray

from e2rl.run.errors import InputError

VEHICLE, PEDESTRIAN, CYCLIST, OTHER = range(4)
AGENT_TYPES = ("vehicle", "pedestrian", "cyclist", "other")
AGENT_WORDS = ("a vehicle", "a pedestrian", "a cyclist", "an object")  # in sentences
LIGHT_UNKNOWN, LIGHT_RED, LIGHT_YELLOW, LIGHT_GREEN = range(4)
COLOURS = {  # words in the names of logs; of several ("red yellow") the first here
    LIGHT_RED: "RED REDYELLOW STOP",
    LIGHT_YELLOW: "YELLOW AMBER CAUTION",
    LIGHT_GREEN: "GREEN GO",
}
# of lights that let nobody wait for another colour
NO_SIGNAL = {"FLASHING", "BLINKING", "OFF", "INACTIVE"}
DT = 0.1  # s, the time step of every recording, scene and simulation
HIDDEN = 5  # steps of absence of who is merely out of sight; after more it is new
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

    points: ndarray
    width: float = 0.0
    speed_limit: float = 0.0
    exits: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    right: list[str] = field(default_factory=list)
    heights: ndarray | None = None


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
    for state, names in COLOURS.items():
        if not words.isdisjoint(names.split()):
            return state
    return otherwise


NUMBERS = "fiu"  # kinds of arrays
FIELDS: tuple[tuple[str, Any, str], ...] = (  # name, classes, in words
    ("ego", int | np.integer, "the index of a track"),
    ("current", int | np.integer | None, "a frame, or None"),
    ("lanes", Mapping, "a dict of Lane objects"),
    ("lights", Mapping, "a dict of arrays"),
    ("drivable", list | tuple, "a list of arrays"),
    ("repairs", Mapping, "a Counter"),
    ("egos", Mapping, "a dict of frames and tracks"),
    ("heights", ndarray | None, "an array [frames, agents], or None"),
    ("towed", list | tuple, "a tuple of tracks"),
    ("coupled", list | tuple, "a tuple of tracks"),
)
Field = tuple[str, Any, bool, str]  # name, value, whether it fits, what is expected
IDS = "a list of ids of lanes, which are texts"
FEW_FRAMES = "fewer than two frames of different time stamps; leave it out"


def name_neighbours(
    lanes: Mapping[str, Lane], beside: Mapping[str, tuple[object, object]]
) -> None:
    """Set the neighbours of lanes to those that a map names, left and right, if they
    are lanes and no oncoming ones, which maps name as well."""

    def same_way(lane: Lane, name: str) -> list[str]:
        other = lanes.get(name)
        if other is None:
            return []
        chord = lane.points[-1] - lane.points[0]
        return [name] if chord @ (other.points[-1] - other.points[0]) > 0 else []

    for name, (left, right) in beside.items():
        lanes[name].left = same_way(lanes[name], str(left))
        lanes[name].right = same_way(lanes[name], str(right))


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
    states: ndarray
    valid: ndarray
    size: ndarray
    agent_type: ndarray
    ego: int
    lanes: dict[str, Lane]
    drivable: list[ndarray] = field(default_factory=list)
    lights: dict[str, ndarray] = field(default_factory=dict)
    current: int | None = HISTORY
    repairs: Counter[str] = field(default_factory=Counter)
    egos: dict[int, int] = field(default_factory=dict)
    heights: ndarray | None = None
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
                recorded; None: the log's own, or, where it names none, as many as fit
                one after another (at least one).
            steps: simulated steps of a scene.
        """
        frames = len(self.states)
        if starts:
            return [start for start in starts if start <= frames - steps // 2]
        if self.current is not None:
            return [self._own_start(self.current, last=frames - steps // 2)]
        return list(range(HISTORY, frames - steps, steps + HISTORY + 1)) or [HISTORY]

    def windows(
        self,
        starts: Sequence[int] | None,
        steps: int,
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
        if not starts and self.current is not None and frames != [self.current]:
            repairs[MOVED_START] += 1
        for start in frames:
            marked = starts or len(frames) > 1
            yield replace(
                self,
                current=start,
                scene_id=f"{self.scene_id}@{start}" if marked else self.scene_id,
                ego=self.egos.get(start, self.ego),
                repairs=+repairs,
            )

    def _own_start(self, current: int, last: int) -> int:
        """Returns the log's own start frame, or where that has not enough past and
        future, the first that has: HISTORY frames with the ego before it, and at most
        `last`."""
        if HISTORY <= current <= last or not self._is_track(self.ego):
            return current
        absent = np.cumsum(~self.valid[:, self.ego])
        before = np.concatenate([np.zeros(HISTORY + 1, int), absent])[: len(absent)]
        enough = np.flatnonzero((absent == before)[: last + 1])
        enough = enough[enough >= HISTORY]
        return int(enough[0]) if len(enough) else current

    def has_ego(self) -> bool:
        """Returns whether the ego is recorded at the start frame."""
        return self._is_track(self.ego) and bool(self.valid[self.current, self.ego])

    def _is_track(self, value: Any) -> bool:
        is_index = isinstance(value, int | np.integer) and not isinstance(value, bool)
        return is_index and 0 <= value < self.valid.shape[1]

    def validate_names(self) -> "Recording":
        """Returns self; raises InputError for a name that is no short text: files,
        tables and messages hold it."""
        for field_name in ("scene_id", "location", "dataset"):
            name = getattr(self, field_name)
            text = isinstance(name, str) and name.isprintable()
            if not text or len(name) > MAX_NAME:
                raise InputError(
                    f"its {field_name} {ascii(name)[:60]} is no line of {MAX_NAME} "
                    "printable characters; rename it"
                )
        if not self.scene_id:
            raise InputError("it has no id; give it one")
        return self

    def validate_fields(self) -> "Recording":
        """Returns self; raises InputError naming the scene and a field that is of
        another kind, type or shape."""
        for name, value, fits, expected in chain(self._fields(), self._map_fields()):
            if not fits:
                array = isinstance(value, ndarray)
                text = " ".join(ascii(value).split())[:40] if not array else ""
                kind = (
                    f"{value.dtype} {list(value.shape)}"
                    if array
                    else f"{type(value).__name__} {text}"
                )
                raise InputError(
                    f"scene {self.scene_id!r}: its {name} is {kind}; "
                    f"expected {expected}"
                )
        return self

    def _fields(self) -> Iterator[Field]:
        valid = self.valid
        is_valid = isinstance(valid, ndarray) and valid.ndim == 2
        is_valid = is_valid and valid.dtype == bool
        yield "valid", valid, is_valid, "a bool array [frames, agents]"
        frames, agents = valid.shape
        shape = f"as valid is of {frames} frames, {agents} agents"
        for name, kinds, sizes, text in (
            ("states", "f", (frames, agents, 4), "a float array [frames, agents, 4]"),
            (
                "size",
                NUMBERS,
                (agents, 2),
                "an array [agents, 2] of lengths and widths",
            ),
            ("agent_type", "iu", (agents,), "an integer array [agents]"),
        ):
            value = getattr(self, name)
            yield name, value, _is_array(value, kinds, sizes), f"{text}, {shape}"
        kinds_fit = (self.agent_type >= VEHICLE) & (self.agent_type <= OTHER)
        numbers = f"numbers from {VEHICLE} to {OTHER}"
        yield "agent_type", self.agent_type, bool(kinds_fit.all()), numbers
        for name, types, text in FIELDS:
            value = getattr(self, name)
            is_type = isinstance(value, types) and not isinstance(value, bool)
            yield name, value, is_type, text
        if self.heights is not None:
            fits = _is_array(self.heights, NUMBERS, (frames, agents))
            yield "heights", self.heights, fits, f"numbers [frames, agents], {shape}"
        for name in ("towed", "coupled"):
            value = getattr(self, name)
            tracks = f"a tuple of tracks from 0 to {agents - 1}"
            yield name, value, all(map(self._is_track, value)), tracks

    def _map_fields(self) -> Iterator[Field]:
        for name, lane in self.lanes.items():
            is_lane = isinstance(name, str) and isinstance(lane, Lane)
            yield "lanes", {name: lane}, is_lane, "a Lane by a text each"
            at = f"lanes[{name!r}]."
            points = lane.points
            yield f"{at}points", points, isinstance(points, ndarray), "an array"
            heights = lane.heights
            if heights is not None:
                is_array = isinstance(heights, ndarray)
                yield f"{at}heights", heights, is_array, "an array"
                fits = _is_array(heights, NUMBERS, points.shape[:1])
                count = len(points) if points.ndim else 0
                numbers = f"{count} numbers, one of each point"
                yield f"{at}heights", heights, fits, numbers
            for part in ("width", "speed_limit"):
                value = getattr(lane, part)
                is_number = isinstance(value, int | float | np.number)
                yield f"{at}{part}", value, is_number, "a number"
            for part in ("exits", "left", "right"):
                value = getattr(lane, part)
                are_ids = isinstance(value, list | tuple)
                are_ids = are_ids and all(isinstance(other, str) for other in value)
                yield f"{at}{part}", value, are_ids, IDS
        for ring in self.drivable:
            is_array = isinstance(ring, ndarray)
            yield "drivable", ring, is_array, "a list of arrays [points, 2]"
        states = f"an integer array of {len(self.valid)} states, by the id of a lane"
        for name, light in self.lights.items():
            fits = _is_array(light, "iu", (len(self.valid),)) and name in self.lanes
            yield f"lights[{name!r}]", light, fits, states

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
            raise InputError(
                f"{scene}: start frame {self.current} leaves no history or no future "
                f"in {frames} frames"
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
            return (
                f"the ego is a {AGENT_TYPES[self.agent_type[self.ego]]}, expected a "
                "vehicle; name another track, or leave the scene out"
            )
        for name, lane in self.lanes.items():
            if not _are_points(lane.points) or lane.points.shape[1] != 2:
                return (
                    f"the centreline of lane {name} is not a list of finite points; "
                    "repair the map or drop the lane"
                )
        if not all(map(_are_points, self.drivable)):
            return "a drivable polygon is not a list of finite points; repair the map"
        bad = np.argwhere(self.valid & ~np.isfinite(self.states).all(-1))
        if len(bad):
            return (
                f"NaN or infinite state of agent {bad[0][1]} at frame {bad[0][0]}; "
                "mark it invalid or repair the log"
            )
        size = self.size[self.valid.any(0)]
        if not (np.isfinite(size).all() and (size > 0).all()):
            return "an agent's length or width is not positive; repair the log"
        return None


def _is_array(
    value: object,
    kinds: str,
    shape: tuple[int, ...],
) -> bool:
    """Returns whether a value is an array of kinds of numbers and of a shape."""
    return (
        isinstance(value, ndarray)
        and value.dtype.kind in kinds
        and value.shape == shape
    )


def _are_points(points: ndarray) -> bool:
    """Whether an array is of finite points [P, 2 or more]."""
    if points.ndim != 2 or points.shape[1] < 2 or points.dtype.kind not in NUMBERS:
        return False
    return bool(np.isfinite(points).all())
