"""Kinds of mutation of a recorded log (python -m tools.mutate): what cannot be right, and what is odd but may be.

A mirror image, of tracks and map together, is legitimate: it is the traffic of a country that drives on the other side.
Swapped axes of both are a mirror image, too. Where lanes lie side by side, a road looks the same from both sides, or
streets cross, a map that is moved by the width of lanes, mirrored or turned on the spot may be one that this traffic
drives on: EITHER is right.
"""

from typing import NamedTuple

import numpy as np

from tools.mutate.changes import (
    MIRROR,
    QUARTER,
    SWAP,
    Change,
    alone,
    at_frame,
    current,
    edit,
    ego_on_foot,
    everything_valid,
    far,
    gap,
    invalid_garbage,
    lanes_of,
    late,
    noisy,
    of_all,
    of_map,
    of_one,
    of_tracks,
    parked,
    purple,
    put,
    reversed_lanes,
    scaled,
    setting,
    shifted_map,
    shuffled,
    stamped,
    twin,
    typed,
    with_lane,
)

FEET, KMH, MPH = 3.28084, 3.6, 2.23694
REFUSED, READ, EITHER = "refused", "read", "either"


class Kind(NamedTuple):
    """A change, what must come of it (either: some copies are logs that could be), and the parts of a log that it
    needs; pickles: of ScenarioDescriptions only."""

    change: Change
    expected: str = REFUSED
    needs: tuple[str, ...] = ()
    pickles: bool = False


KINDS: dict[str, Kind] = {
    # headings
    "headings in degrees": Kind(setting("heading", lambda log: np.degrees(log.heading))),
    "the ego's heading in degrees": Kind(of_one("heading", np.degrees, ego=True)),
    "headings reversed": Kind(setting("heading", lambda log: log.heading + np.pi)),
    "headings of a compass": Kind(setting("heading", lambda log: np.pi / 2 - log.heading)),
    "headings clockwise": Kind(setting("heading", lambda log: -log.heading)),
    "headings all 0": Kind(setting("heading", lambda log: 0 * log.heading)),
    # mirrored, swapped, turned
    "positions of tracks mirrored": Kind(of_tracks(MIRROR, headings=False)),
    "tracks mirrored": Kind(of_tracks(MIRROR)),
    "tracks mirrored on the spot": Kind(of_tracks(MIRROR, here=True), EITHER),
    "map mirrored": Kind(of_map(MIRROR)),
    "map mirrored on the spot": Kind(of_map(MIRROR, here=True), EITHER),
    "map and tracks mirrored": Kind(of_all(MIRROR), READ),
    "positions with swapped axes": Kind(of_tracks(SWAP, headings=False)),
    "tracks with swapped axes": Kind(of_tracks(SWAP)),
    "map with swapped axes": Kind(of_map(SWAP)),
    "all with swapped axes": Kind(of_all(SWAP), READ),
    "map turned by 90 degrees": Kind(of_map(QUARTER, here=True), EITHER),
    "all turned by 90 degrees": Kind(of_all(QUARTER), READ),
    # units
    "all in feet": Kind(scaled(FEET, "position", "velocity", "size", "lines")),
    "positions, map and speeds in feet": Kind(scaled(FEET, "position", "velocity", "lines")),
    "positions and map in feet": Kind(scaled(FEET, "position", "lines"), needs=("velocity",)),
    "tracks in feet": Kind(scaled(FEET, "position", "velocity", "size")),
    "map in feet": Kind(scaled(FEET, "lines")),
    "feet taken for metres twice": Kind(scaled(1 / FEET, "position", "velocity", "size", "lines")),
    "all in millimetres": Kind(scaled(1000, "position", "velocity", "size", "lines")),
    "positions and map in millimetres": Kind(scaled(1000, "position", "lines")),
    "all in kilometres": Kind(scaled(1e-3, "position", "velocity", "size", "lines")),
    "speeds in km/h": Kind(scaled(KMH, "velocity"), needs=("velocity",)),
    "speeds in mph": Kind(scaled(MPH, "velocity"), needs=("velocity",)),
    "speeds halved": Kind(scaled(0.5, "velocity"), needs=("velocity",)),
    "speeds all 0": Kind(scaled(0.0, "velocity"), needs=("velocity",)),
    "sizes in feet": Kind(scaled(FEET, "size"), needs=("size",)),
    "sizes in centimetres": Kind(scaled(100, "size"), needs=("size",)),
    "a car of 200 m": Kind(of_one("size", lambda size: size * [0, 1] + [200, 0]), needs=("size",)),
    "a car without width": Kind(of_one("size", lambda size: size * [1, 0]), needs=("size",)),
    "a size of NaN": Kind(of_one("size", lambda size: size * np.nan), needs=("size",)),
    # places
    "map 5 km away": Kind(shifted_map((3000, 4000))),
    "map 15 m aside": Kind(shifted_map((0, 15)), EITHER),
    "map 9 m aside": Kind(shifted_map((0, 9)), EITHER),
    "lanes turned against the traffic": Kind(lambda log: setattr(log, "edits", [reversed_lanes]), EITHER, pickles=True),
    "all 300 km away": Kind(lambda log: far(log, 3e5), READ),
    "tracks of the frames shuffled": Kind(shuffled),
    "positions with 2 m of noise": Kind(noisy(2.0)),
    "one vehicle in feet": Kind(of_one("position", lambda place: place * FEET)),
    "one vehicle in degrees": Kind(of_one("heading", np.degrees)),
    "one vehicle 15 km away": Kind(of_one("position", lambda place: place + 15_000.0)),
    "one vehicle at 1e9": Kind(of_one("position", lambda place: place + 1e9)),
    "one frame at 1e9": Kind(at_frame("position", 1e9)),
    "one position of NaN": Kind(at_frame("position", np.nan)),
    "one heading of infinity": Kind(at_frame("heading", np.inf)),
    "one velocity of NaN": Kind(at_frame("velocity", np.nan), needs=("velocity",)),
    "the ego's position of NaN": Kind(at_frame("position", np.nan, ego=True)),
    # time
    "time stamps in milliseconds": Kind(stamped(lambda ts: ts * 1e3)),
    "time stamps in microseconds": Kind(stamped(lambda ts: ts * 1e6)),
    "time stamps of 5 Hz": Kind(stamped(lambda ts: ts * 2), needs=("velocity",)),
    "time stamps reversed": Kind(stamped(lambda ts: ts[::-1]), pickles=True),
    "two time stamps swapped": Kind(stamped(lambda ts: ts[[*range(20), 21, 20, *range(22, len(ts))]]), pickles=True),
    "one time stamp twice": Kind(stamped(lambda ts: put(ts, 20, ts[19])), pickles=True),
    "time stamps all the same": Kind(stamped(lambda ts: 0 * ts), pickles=True),
    "a time stamp of NaN": Kind(stamped(lambda ts: put(ts, 20, np.nan)), pickles=True),
    "a last time stamp a day later": Kind(stamped(lambda ts: put(ts, -1, ts[-1] + 86_400)), pickles=True),
    "time stamps from 1.7e9 s on": Kind(stamped(lambda ts: ts + 1.7e9), READ, pickles=True),
    # who is there
    "late tracks": Kind(late, READ),
    "half a second without the others": Kind(gap, READ),
    "nobody but the ego": Kind(alone, READ, pickles=True),
    "frames without a record marked valid": Kind(everything_valid, pickles=True),
    "NaN where nothing is recorded": Kind(invalid_garbage, READ, pickles=True),
    "2,000 parked vehicles": Kind(parked(2000), READ, pickles=True),
    "a track twice under one id": Kind(twin(True), pickles=True),
    "the ego twice under one id": Kind(twin(True, ego=True), pickles=True),
    "a track twice under two ids": Kind(twin(False), pickles=True),
    "types of an unknown kind": Kind(typed("SPACESHIP", some=False), pickles=True),
    "one type of an unknown kind": Kind(typed("SPACESHIP", some=True), pickles=True),
    "types in lower case": Kind(typed("vehicle", some=False), pickles=True),
    "an ego that is not there": Kind(edit(lambda data: data["metadata"].update(sdc_id="nobody")), pickles=True),
    "an ego that is a pedestrian": Kind(
        edit(lambda data: data["tracks"].update({data["metadata"]["sdc_id"]: ego_on_foot(data)})), pickles=True
    ),
    "no tracks": Kind(edit(lambda data: data.update(tracks={})), pickles=True),
    # the map
    "no map": Kind(edit(lambda data: data.update(map_features={})), pickles=True),
    "a lane of 1e7 m": Kind(with_lane([[0, 0], [1e7, 0]]), pickles=True),
    "a lane at NaN": Kind(with_lane([[0, 0], [np.nan, 0]]), pickles=True),
    "a lane of no length": Kind(with_lane([[0, 0], [0, 0]]), READ, pickles=True),
    "a lane of one point": Kind(with_lane([[0, 0]]), READ, pickles=True),
    "lanes all of no length": Kind(
        lanes_of(lambda lane: lane.update(polyline=0 * np.asarray(lane.get("polyline", ())))), pickles=True
    ),
    "lanes of an unknown kind": Kind(lanes_of(lambda lane: lane.update(type="CANAL")), pickles=True),
    "lights of an unknown colour": Kind(
        edit(
            lambda data: data.update(dynamic_map_states={k: purple(v) for k, v in data["dynamic_map_states"].items()})
        ),
        READ,
        pickles=True,
    ),
    # the start frame
    "current_time_index of infinity": Kind(current(float("inf")), pickles=True),
    "current_time_index of NaN": Kind(current(float("nan")), pickles=True),
    "current_time_index of -1": Kind(current(-1), pickles=True),
    "current_time_index of 1e9": Kind(current(1e9), pickles=True),
    "current_time_index of 10.5": Kind(current(10.5), pickles=True),
    "current_time_index as text": Kind(current("10"), pickles=True),
}
