"""The replay of a failure in the HTML report: the motion of all agents, of the
competent driver in the ego's place and of the recorded ego.

Arrays of whole numbers as short text, which a browser decodes without a library
(e2rl/assets/report/decode.js).

Smooth motion has small second differences, whose upper bytes are zero; deflate makes
next to nothing of them.
"""

import base64
import json
import zlib
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from e2rl.metrics.preventable import AFTER
from e2rl.scenes.boxes import corners, separation, to_frame
from e2rl.sim.rollout_file import Failure, Rollout
from e2rl.traffic.traffic import POINT_STEPS, REPLAN_STEPS


def quantised(values: np.ndarray, quantum: float | np.ndarray) -> np.ndarray:
    """Values as int64 multiples of a quantum; they must fit into 29 bits, so that
    second differences fit into 31."""
    return np.rint(np.asarray(values, np.float64) / quantum).astype(np.int64)


def second_difference(values: np.ndarray) -> np.ndarray:
    """Second difference along the last axis, with zeros before the first value: two
    cumulative sums undo it."""
    ahead = [(0, 0)] * (values.ndim - 1) + [(2, 0)]
    return np.diff(np.pad(values, ahead), n=2, axis=-1)


def encode(values: np.ndarray) -> str:
    """Whole numbers in C order as base64 of zlib of their zigzag code, uint32, all
    lowest bytes first."""
    flat = np.asarray(values, np.int64).ravel()
    zigzag = ((flat << 1) ^ (flat >> 63)).astype("<u4")
    planes = zigzag.view(np.uint8).reshape(-1, 4).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode()


KINDS = ("cyclist", "pedestrian")  # of agents, drawn as such whoever drives them
IN_ITS_PLACE = ("ego", "driver", "evasion", "recorded")  # roles that have a gap
CHANNELS = {
    "x": 0.01,
    "y": 0.01,
    "heading": 0.001,
    "speed": 0.01,
    "present": 1.0,
    "gap": 0.01,
}  # quanta: m, rad, m/s
MAP_QUANTUM = 0.05  # m


class Track(NamedTuple):
    """A box in motion: size (length, width) [m], states [K, 4], present [K] bool.

    role: ego, adversary, traffic (simulated), replayed, cyclist, pedestrian; or
    somebody else in the ego's place: driver (the competent one), evasion, recorded.
    """

    role: str
    size: np.ndarray
    states: np.ndarray
    present: np.ndarray


def failure_replay(failure: Failure, beside: Failure | None = None) -> dict[str, Any]:
    """The replay of a failure, from the start to AFTER steps beyond the contact, for
    the data block of the page. Of a rollout without a contact: as many steps as of the
    failure `beside` it in the same scene, with that one's partner.

    `tracks` has the role, length and width [m] of each track, `partner` and `contact`
    are a track and a step, `point` [m] is where they touch; without a contact the last
    step and None. `motion` encodes the second differences over time of the CHANNELS [6,
    tracks, K] in their quanta; the gap [m] is that of the ego, and of those in its
    place, to the partner. `plans` may be None.
    """
    rollout = failure.rollout
    contact = failure.contact
    like = beside if contact is None and beside else failure
    assert like.contact is not None
    steps = min(like.contact + AFTER + 1, len(rollout.states))
    rows = np.union1d(np.flatnonzero(rollout.valid[:steps].any(0)), like.partner)
    tracks = [track_of(rollout, row, steps) for row in rows.tolist()]
    tracks += other_egos(rollout, steps)
    partner = int(np.searchsorted(rows, like.partner))
    motion = np.stack([channels_of(track, tracks[partner]) for track in tracks], 1)
    quanta = np.array(list(CHANNELS.values()))[:, None, None]
    point = None
    if contact is not None:
        where = contact_point(rollout, contact, partner=like.partner)
        point = where.round(2).tolist()
    return {
        "tracks": [
            [track.role, *(round(float(side), 2) for side in track.size)]
            for track in tracks
        ],
        "partner": partner,
        "contact": steps - 1 if contact is None else contact,
        "point": point,
        "dt": rollout.dt,
        "motion": encode(second_difference(quantised(motion, quanta))),
        "plans": encoded_plans(rollout, rows) if rollout.plans is not None else None,
    }


class Encoded(NamedTuple):
    """A replay, and its map as JSON."""

    replay: dict[str, Any]
    map: str


def encoded_failure(failure: Failure, beside: Failure | None = None) -> Encoded:
    """The replay of a failure, which `failure_replay` explains, with its map."""
    text = json.dumps(encoded_map(failure.rollout))
    return Encoded(failure_replay(failure, beside), text)


def replay_data(failures: Iterable[Encoded], count: int) -> dict[str, Any]:
    """The fields of the data block that hold `count` replays; scenes share their map."""
    maps: dict[str, int] = {}
    replays = []
    bar = tqdm(failures, "replays", count, leave=False, disable=None, delay=1)
    for replay, text in bar:
        number = maps.setdefault(text, len(maps))
        replays.append(replay | {"map": number})
    return {
        "maps": list(map(json.loads, maps)),
        "replays": replays,
        "channels": CHANNELS,
        "map_quantum": MAP_QUANTUM,
    }


def contact_point(rollout: Rollout, step: int, partner: int) -> np.ndarray:
    """Where the ego and its partner touch [2] m: the mean of the corners that lie
    inside the other box, or, where there are none, the middle between the two centres.
    """
    pair = [rollout.ego, partner]
    pose = torch.tensor(rollout.states[step, pair]).double()
    size = torch.tensor(rollout.size[pair]).double()
    others = corners(pose, size).flip(0)
    inside = (to_frame(others, pose[:, None]).abs() <= size[:, None] / 2 + 1e-6).all(-1)
    return (others[inside] if inside.any() else pose[:, :2]).mean(0).numpy()


def track_of(rollout: Rollout, row: int, steps: int) -> Track:
    """The agent's track over the first `steps` states."""
    return Track(
        role_of(rollout, row),
        rollout.size[row],
        states=rollout.states[:steps, row],
        present=rollout.valid[:steps, row],
    )


def role_of(rollout: Rollout, row: int) -> str:
    """The agent's role (`Track`)."""
    if row == rollout.ego:
        return "ego"
    kind = str(rollout.agent_type[row])
    if kind in KINDS:
        return kind
    if rollout.adversaries[row]:
        return "adversary"
    return "traffic" if rollout.simulated[row] else "replayed"


def other_egos(rollout: Rollout, steps: int) -> list[Track]:
    """Others in the ego's place: the careful and competent driver of UN R157 as the
    verdict has it, the recording, and the evasion that the search found; where the file
    has them."""
    ego = rollout.ego
    always = np.ones(steps, bool)
    recorded = rollout.logged_valid[:steps, ego]
    return [
        Track(role, rollout.size[ego], states=states[:steps], present=present)
        for role, states, present in (
            ("driver", rollout.driver, always),
            ("recorded", rollout.logged[:, ego], recorded),
            ("evasion", rollout.evasion, always),
        )
        if states is not None
    ]


def channels_of(track: Track, partner: Track) -> np.ndarray:
    """The CHANNELS [6, K] of a track; where it is absent its pose is held, which takes
    next to no bytes."""
    states = held(track.states, track.present)
    states[:, 2] = np.unwrap(states[:, 2])
    gap = np.zeros(len(states))
    if track.role in IN_ITS_PLACE:
        distance = separation(
            torch.as_tensor(states, dtype=torch.float64),
            torch.as_tensor(track.size, dtype=torch.float64),
            second=torch.as_tensor(
                held(partner.states, partner.present), dtype=torch.float64
            ),
            second_size=torch.as_tensor(partner.size, dtype=torch.float64),
        )
        gap = distance.clamp(min=0).numpy()
    return np.concatenate([states.T, [track.present, gap]])


def held(states: np.ndarray, present: np.ndarray) -> np.ndarray:
    """States [K, 4] with those of absent steps replaced by the last present ones,
    before any by the first."""
    step = np.maximum.accumulate(np.where(present, np.arange(len(present)), -1))
    return np.nan_to_num(
        states[np.where(step < 0, present.argmax(), step)].astype(np.float64)
    )


def encoded_plans(rollout: Rollout, rows: np.ndarray) -> dict[str, Any]:
    """Plans of the ego and the adversaries: `agents`, their tracks; `points` [A, R, 2,
    K] as second differences in the quantum of x; `targets` [A, R], the track that an
    adversary aims at, -1 for none. Steps between plans: `every`, between points:
    `spacing`."""
    assert rollout.planners is not None
    assert rollout.plans is not None
    assert rollout.targets is not None
    shown = np.isin(rollout.planners, rows)
    points = rollout.plans[:, shown].transpose(1, 0, 3, 2)
    targets = rollout.targets[:, shown].T
    aimed = np.where(np.isin(targets, rows), np.searchsorted(rows, targets), -1)
    return {
        "agents": np.searchsorted(rows, rollout.planners[shown]).tolist(),
        "every": REPLAN_STEPS,
        "spacing": POINT_STEPS,
        "points": encode(second_difference(quantised(points, CHANNELS["x"]))),
        "targets": encode(aimed),
    }


def encoded_map(rollout: Rollout) -> dict[str, str]:
    """The map of a rollout: of `lane` and `drivable` lines the points [M, 2], all x,
    then all y, as second differences in MAP_QUANTUM, and the number of points of each
    line; the lanes' widths in MAP_QUANTUM."""
    result = {"lane_width": encode(quantised(rollout.lane_width, MAP_QUANTUM))}
    for name in ("lane", "drivable"):
        points = quantised(getattr(rollout, f"{name}_points").T, MAP_QUANTUM)
        result[f"{name}_points"] = encode(second_difference(points))
        result[f"{name}_counts"] = encode(np.diff(getattr(rollout, f"{name}_offsets")))
    return result
