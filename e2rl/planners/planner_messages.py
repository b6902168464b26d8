"""The messages between e2rl and a planner outside of it.

docs/guide/planner.md has these field by field. All numbers have 4 bytes,
little-endian.
"""

import struct

import numpy as np
import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS
from e2rl.planners.ego_errors import PlannerError
from e2rl.sim.mission import Mission, light_state_at, mission_of
from e2rl.sim.world import World

VERSION = 1
HELLO, SCENE, PLAN = 1, 2, 3  # to the planner
TRAJECTORY, ACTION, FAILED = 4, 5, 6  # from the planner, besides HELLO
HEADER = struct.Struct("<II")  # kind, length of the payload in bytes
MAX_TEXT = 1000  # bytes of the text of FAILED
MAX_REPLY = 4 + max(4 + 16 * PLAN_STEPS, MAX_TEXT)  # bytes of a reply's payload
AGENT_WORDS = 10
Reply = tuple[int, bytes]  # kind and payload of a message


class BadReply(PlannerError):
    """A reply that the protocol does not allow, or a plan that is not finite or no
    vehicle can drive."""


class PlannerFailed(PlannerError):
    """The planner says that it failed."""


def message(kind: int, payload: bytes) -> bytes:
    """A message: its header and its payload."""
    return HEADER.pack(kind, len(payload)) + payload


def scene_messages(world: World, rows: list[int]) -> bytes:
    """SCENE of the given rows of a World: map, mission and the ego's size."""
    mission = mission_of(world.scene)
    return b"".join(_scene(world, mission, row=row) for row in rows)


def _scene(
    world: World,
    mission: Mission,
    row: int,
) -> bytes:
    scene = world.scene[row]
    on_lane = scene["lane_index"] >= 0  # others are padding
    lane = scene["lane_index"][on_lane]
    points = scene["lane_points"][on_lane]
    lanes = int(lane.max()) + 1 if len(lane) else 0
    counts = [
        row,
        int(scene["scene_index"]),
        mission.points.shape[1],
        len(points),
        lanes,
        len(scene["light_points"]),
    ]
    columns = [
        scene["lane_width"][:, None],
        scene["lane_left"][:, None],
        scene["lane_right"][:, None],
        scene["lane_exits"],
    ]
    parts = [
        _words(torch.tensor(counts)),
        _words(scene["size"][0], mission.end[row, None]),
        _words(mission.points[row], mission.limit[row, :, None]),
        _words(mission.light[row, :, None], mission.light_s[row, :, None]),
        _words(lane[:, None], points),
        _words(*(column[:lanes] for column in columns)),
        _words(scene["light_points"]),
    ]
    return message(SCENE, b"".join(_bytes(part) for part in parts))


def plan_message(world: World) -> bytes:
    """PLAN of all scenes of a World: the agents that are there, and the lights, now."""
    count, agents = world.valid.shape
    scene = world.scene
    row = torch.arange(count, device=world.step.device)
    lights = torch.arange(scene["light_state"].shape[-1], device=row.device)
    light_state = light_state_at(
        scene["light_state"],
        lights.expand(count, -1),
        step=world.step,
    )
    records = _words(
        torch.arange(agents, device=row.device).expand(count, -1)[..., None],
        scene["agent_type"][..., None],
        world.states,
        scene["size"],
        world.accel[..., None],
        world.turn_rate[..., None],
    )  # [B, N, AGENT_WORDS]
    counts = [
        row,
        world.step,
        world.valid.sum(1),
        torch.full_like(row, len(lights)),
    ]
    head = _words(torch.stack(counts, -1), light_state)
    body = torch.cat([head, records.flatten(1)], 1)
    present = world.valid.repeat_interleave(AGENT_WORDS, 1)
    sent = torch.cat([torch.ones_like(head, dtype=torch.bool), present], 1)
    return message(PLAN, struct.pack("<I", count) + _bytes(body[sent]))


def read_scene(reply: Reply) -> int:
    """The number of the scene that a reply is for."""
    kind, payload = reply
    if kind not in (TRAJECTORY, ACTION, FAILED) or len(payload) < 4:
        raise BadReply(
            f"a message of kind {kind} and {len(payload)} bytes is no reply to PLAN"
        )
    return struct.unpack_from("<I", payload)[0]


def read_reply(reply: Reply) -> np.ndarray:
    """States [K, 4] or an action [2] of a reply; raises PlannerFailed or BadReply."""
    kind, payload = reply
    if kind == FAILED:
        raise PlannerFailed(payload[4:].decode(errors="replace"))
    if kind == ACTION:
        if len(payload) != 12:
            raise BadReply(f"an ACTION has 12 bytes, this one {len(payload)}")
        return np.frombuffer(payload, "<f4", offset=4).astype(np.float32)
    count = struct.unpack_from("<I", payload, 4)[0] if len(payload) >= 8 else 0
    if not 1 <= count <= PLAN_STEPS or len(payload) != 8 + 16 * count:
        raise BadReply(
            f"a TRAJECTORY has 8 + 16 K bytes for 1 to {PLAN_STEPS} states; this one has "
            f"{len(payload)} bytes for {count} states"
        )
    return np.frombuffer(payload, "<f4", offset=8).reshape(count, 4).astype(np.float32)


def _words(*values: Tensor) -> Tensor:
    """The 4 bytes of each number, as int32, side by side along the last dimension."""
    words = [
        value.float().contiguous().view(torch.int32)
        if value.is_floating_point()
        else value.int()
        for value in values
    ]
    return torch.cat(words, -1)


def _bytes(words: Tensor) -> bytes:
    return words.cpu().numpy().astype("<i4", copy=False).tobytes()
