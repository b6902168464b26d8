"""The bytes that e2rl and a planner outside of it exchange (docs/how-to/planner.md has them field by field).

A message is a header, (kind, length of the payload in bytes), and a payload. All numbers have 4 bytes, little-endian.
"""

import struct

import numpy as np
import torch
from torch import Tensor

from e2rl.ego.base import PLAN_STEPS
from e2rl.scene.recording import DT
from e2rl.sim.mission import Mission, mission_of
from e2rl.sim.traffic_light import light_state_at
from e2rl.sim.world import World

VERSION = 1
HELLO, SCENE, PLAN = 1, 2, 3  # to the planner
TRAJECTORY, ACTION, FAILED = 4, 5, 6  # from the planner, besides HELLO
HEADER = struct.Struct("<II")  # kind, length of the payload in bytes
MAX_TEXT = 1000  # bytes of the text of FAILED
MAX_REPLY = 4 + max(4 + 16 * PLAN_STEPS, MAX_TEXT)  # bytes of a reply's payload
AGENT_WORDS = 10


class Malformed(ValueError):
    """A payload that its kind does not allow."""


class Failed(Exception):
    """The planner replied that it failed, and why."""


def message(kind: int, payload: bytes) -> bytes:
    return HEADER.pack(kind, len(payload)) + payload


def hello(replan_every: int) -> bytes:
    """HELLO of a simulator that asks for a plan every so many steps."""
    return message(HELLO, struct.pack("<IfII", VERSION, DT, PLAN_STEPS, replan_every))


def scene_messages(world: World, rows: list[int]) -> bytes:
    """SCENE of the given rows of a World: map, mission and the ego's size."""
    mission = mission_of(world.scene)
    return b"".join(_scene(world, mission, row) for row in rows)


def _scene(world: World, mission: Mission, row: int) -> bytes:
    scene = world.scene[row]
    on_lane = scene["lane_index"] >= 0  # others are padding
    lane, points = scene["lane_index"][on_lane], scene["lane_points"][on_lane]
    lanes = int(lane.max()) + 1 if len(lane) else 0
    counts = [row, int(scene["scene_index"]), mission.points.shape[1], len(points), lanes, len(scene["light_points"])]
    about = [scene[key][:lanes, None] for key in ("lane_width", "lane_left", "lane_right")]
    parts = [
        torch.tensor(counts),
        torch.cat([scene["size"][0], mission.end[row, None]]),
        torch.cat([mission.points[row], mission.limit[row, :, None]], -1),
        torch.stack([_words(mission.light[row]), _words(mission.light_s[row])], -1),
        torch.cat([_words(lane)[:, None], _words(points)], -1),
        torch.cat([_words(part) for part in (*about, scene["lane_exits"][:lanes])], -1),
        scene["light_points"],
    ]
    return message(SCENE, b"".join(_bytes(_words(part)) for part in parts))


def plan_message(world: World) -> bytes:
    """PLAN of all scenes of a World: the agents that are there, and the lights, now."""
    count, agents = world.valid.shape
    scene, row = world.scene, torch.arange(count, device=world.step.device)
    lights = torch.arange(scene["light_state"].shape[-1], device=row.device).expand(count, -1)
    state = light_state_at(scene["light_state"], lights, world.step)
    turn = torch.zeros_like(world.accel) if world.turn_rate is None else world.turn_rate
    number = torch.arange(agents, device=row.device).expand(count, -1)
    fields = [number[..., None], scene["agent_type"][..., None], world.states, scene["size"]]
    fields += [world.accel[..., None], turn[..., None]]
    record = torch.cat([_words(field) for field in fields], -1)  # [B, N, AGENT_WORDS]
    head = torch.stack([row, world.step, world.valid.sum(1), torch.full_like(row, lights.shape[1])], -1)
    body = torch.cat([_words(head), _words(state), record.flatten(1)], 1)
    there = world.valid.repeat_interleave(AGENT_WORDS, 1)
    sent = torch.cat([there.new_ones(count, body.shape[1] - there.shape[1]), there], 1)
    return message(PLAN, struct.pack("<I", count) + _bytes(body[sent]))


def read_version(kind: int, payload: bytes) -> int:
    """The version of a planner's HELLO."""
    if kind != HELLO or len(payload) != 4:
        raise Malformed(f"its first message is of kind {kind} and {len(payload)} bytes, not HELLO ({HELLO}) of 4")
    return struct.unpack("<I", payload)[0]


def read_scene(kind: int, payload: bytes) -> int:
    """The number of the scene that a reply is for."""
    if kind not in (TRAJECTORY, ACTION, FAILED) or len(payload) < 4:
        raise Malformed(f"a message of kind {kind} and {len(payload)} bytes is no reply to PLAN")
    return struct.unpack_from("<I", payload)[0]


def read_reply(kind: int, payload: bytes) -> np.ndarray:
    """States [K, 4] or an action [2] of a reply; raises Failed or Malformed."""
    if kind == FAILED:
        raise Failed(payload[4:].decode(errors="replace"))
    if kind == ACTION:
        if len(payload) != 12:
            raise Malformed(f"an ACTION has 12 bytes, this one {len(payload)}")
        return np.frombuffer(payload, "<f4", offset=4).astype(np.float32)
    count = struct.unpack_from("<I", payload, 4)[0] if len(payload) >= 8 else 0
    if not 1 <= count <= PLAN_STEPS or len(payload) != 8 + 16 * count:
        size = f"{len(payload)} bytes for {count} states"
        raise Malformed(f"a TRAJECTORY has 8 + 16 K bytes for 1 to {PLAN_STEPS} states; this one has {size}")
    return np.frombuffer(payload, "<f4", offset=8).reshape(count, 4).astype(np.float32)


def _words(values: Tensor) -> Tensor:
    """The 4 bytes of each number, as int32."""
    return values.float().contiguous().view(torch.int32) if values.is_floating_point() else values.int()


def _bytes(words: Tensor) -> bytes:
    return words.cpu().numpy().astype("<i4", copy=False).tobytes()
