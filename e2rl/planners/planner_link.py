"""The connection to a planner outside of e2rl, the process that it runs in where e2rl
starts it, and their messages.

docs/how-to/planner.md has these field by field. All numbers have 4 bytes,
little-endian.
"""

import shlex
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import time
from multiprocessing.util import Finalize

import numpy as np
import torch
from torch import Tensor

from e2rl.planners.ego import PLAN_STEPS, PlannerError
from e2rl.run import process_tree
from e2rl.run.errors import InputError
from e2rl.scenes.recording import DT
from e2rl.sim.mission import Mission, light_state_at, mission_of
from e2rl.sim.world import World

VERSION = 1
HELLO, SCENE, PLAN = 1, 2, 3  # to the planner
TRAJECTORY, ACTION, FAILED = 4, 5, 6  # from the planner, besides HELLO
HEADER = struct.Struct("<II")  # kind, length of the payload in bytes
MAX_TEXT = 1000  # bytes of the text of FAILED
MAX_REPLY = 4 + max(4 + 16 * PLAN_STEPS, MAX_TEXT)  # bytes of a reply's payload
AGENT_WORDS = 10


class BadReply(PlannerError):
    """A reply that the protocol does not allow, or a plan that is not finite or no
    vehicle can drive."""


class PlannerFailed(PlannerError):
    """The planner says that it failed."""


def message(kind: int, payload: bytes) -> bytes:
    return HEADER.pack(kind, len(payload)) + payload


def scene_messages(world: World, rows: list[int]) -> bytes:
    """SCENE of the given rows of a World: map, mission and the ego's size."""
    mission = mission_of(world.scene)
    return b"".join(_scene(world, mission, row=row) for row in rows)


def _scene(world: World, mission: Mission, row: int) -> bytes:
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
    about = [
        scene[key][:lanes, None] for key in ("lane_width", "lane_left", "lane_right")
    ]
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
    scene = world.scene
    row = torch.arange(count, device=world.step.device)
    lights = torch.arange(scene["light_state"].shape[-1], device=row.device).expand(
        count, -1
    )
    state = light_state_at(scene["light_state"], lights, step=world.step)
    number = torch.arange(agents, device=row.device).expand(count, -1)
    fields = [
        number[..., None],
        scene["agent_type"][..., None],
        world.states,
        scene["size"],
    ]
    fields += [world.accel[..., None], world.turn_rate[..., None]]
    record = torch.cat([_words(field) for field in fields], -1)  # [B, N, AGENT_WORDS]
    head = torch.stack(
        [row, world.step, world.valid.sum(1), torch.full_like(row, lights.shape[1])], -1
    )
    body = torch.cat([_words(head), _words(state), record.flatten(1)], 1)
    there = world.valid.repeat_interleave(AGENT_WORDS, 1)
    sent = torch.cat([there.new_ones(count, body.shape[1] - there.shape[1]), there], 1)
    return message(PLAN, struct.pack("<I", count) + _bytes(body[sent]))


def read_scene(kind: int, payload: bytes) -> int:
    """The number of the scene that a reply is for."""
    if kind not in (TRAJECTORY, ACTION, FAILED) or len(payload) < 4:
        raise BadReply(
            f"a message of kind {kind} and {len(payload)} bytes is no reply to PLAN"
        )
    return struct.unpack_from("<I", payload)[0]


def read_reply(kind: int, payload: bytes) -> np.ndarray:
    """States [K, 4] or an action [2] of a reply; raises PlannerFailed or BadReply."""
    if kind == FAILED:
        raise PlannerFailed(payload[4:].decode(errors="replace"))
    if kind == ACTION:
        if len(payload) != 12:
            raise BadReply(f"an ACTION has 12 bytes, this one {len(payload)}")
        return np.frombuffer(payload, "<f4", offset=4).astype(np.float32)
    count = struct.unpack_from("<I", payload, 4)[0] if len(payload) >= 8 else 0
    if not 1 <= count <= PLAN_STEPS or len(payload) != 8 + 16 * count:
        size = f"{len(payload)} bytes for {count} states"
        raise BadReply(
            f"a TRAJECTORY has 8 + 16 K bytes for 1 to {PLAN_STEPS} states; this one has {size}"
        )
    return np.frombuffer(payload, "<f4", offset=8).reshape(count, 4).astype(np.float32)


def _words(values: Tensor) -> Tensor:
    """The 4 bytes of each number, as int32."""
    return (
        values.float().contiguous().view(torch.int32)
        if values.is_floating_point()
        else values.int()
    )


def _bytes(words: Tensor) -> bytes:
    return words.cpu().numpy().astype("<i4", copy=False).tobytes()


STDERR = 2  # file descriptor
PAUSE = 0.02  # s between two attempts to connect
ANSWERS = 5.0  # s in which a planner that runs takes a connection
GRACE = 1.0  # s that a connection, or the end of a process, may take
Process = subprocess.Popen[bytes]


class PlannerLink:
    """A connection over which greetings were exchanged; of the process that opened it,
    in which it is closed with the link's last reference, or at the end."""

    def __init__(
        self,
        command: str | None,
        address: str | None,
        replan_every: int,
        timeout: float,
    ) -> None:
        """Start `command` with an address as its last argument, or connect to the
        `address` of a planner that runs.

        Raises InputError where none answers within `timeout` s.
        """
        self.buffer = bytearray()
        """What came beyond the last message taken."""
        self._name = (
            f"ego.address={address}" if command is None else f"ego.command={command}"
        )
        self._process = None
        begun = time.monotonic()
        deadline = begun + timeout
        try:
            if command is None:
                self._socket = connect(
                    str(address),
                    None,
                    deadline=begun + min(timeout, ANSWERS),
                    name=self._name,
                )
            else:  # a connection does not need its path
                with tempfile.TemporaryDirectory(
                    prefix="e2rl-", ignore_cleanup_errors=True
                ) as folder:
                    self._process = start(command, f"unix:{folder}/planner")
                    self._socket = connect(
                        f"unix:{folder}/planner",
                        self._process,
                        deadline=deadline,
                        name=self._name,
                    )
        except BaseException:
            close(None, self._process)
            raise
        self.close = Finalize(
            self, close, (self._socket, self._process), exitpriority=10
        )
        self._greet(replan_every, deadline)

    def _greet(self, replan_every: int, deadline: float) -> None:
        try:
            about = struct.pack("<IfII", VERSION, DT, PLAN_STEPS, replan_every)
            self.send(message(HELLO, about), deadline)
            kind, payload = self.receive(deadline)
            if kind != HELLO or len(payload) != 4:
                raise BadReply(
                    f"its first message is of kind {kind} and {len(payload)} bytes, not HELLO of 4"
                )
            (version,) = struct.unpack("<I", payload)
        except (OSError, EOFError, BadReply) as error:
            self.close()
            raise InputError(
                f"{self._name}: no planner answers there: {error or 'no HELLO in time'}"
            ) from error
        if version != VERSION:
            self.close()
            raise InputError(
                f"{self._name}: the planner speaks version {version} of the protocol, e2rl {VERSION}"
            )

    def send(self, content: bytes, deadline: float) -> None:
        """Send messages. Raises TimeoutError, or OSError where the connection broke."""
        self._socket.settimeout(max(deadline - time.monotonic(), PAUSE))
        self._socket.sendall(content)

    def receive(self, deadline: float) -> tuple[int, bytes]:
        """Kind and payload of the next message. Raises TimeoutError; EOFError or
        OSError where the connection broke; BadReply where the payload is longer than
        any reply's."""
        kind, length = HEADER.unpack(self._take(HEADER.size, deadline))
        if length > MAX_REPLY:
            raise BadReply(
                f"a message of kind {kind} announces {length} bytes; replies have at most {MAX_REPLY}"
            )
        return kind, self._take(length, deadline)

    def _take(self, count: int, deadline: float) -> bytes:
        while len(self.buffer) < count:
            left = deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError("no reply in time")
            self._socket.settimeout(left)
            part = self._socket.recv(1 << 16)
            if not part:
                raise EOFError("it closed the connection")
            self.buffer += part
        taken = bytes(self.buffer[:count])
        del self.buffer[:count]
        return taken

    def ending(self) -> str:
        """How the planner's process ended, as far as is known."""
        if self._process is None:
            return "the connection broke"
        try:
            return f"its process ended with status {self._process.wait(GRACE)} (what it said is on stderr)"
        except subprocess.TimeoutExpired:
            return "it closed the connection"


def start(command: str, address: str) -> Process:
    """The process of a command, which is given the address to listen at.

    On Linux it ends with this process, with all that it has started
    (`e2rl.run.process_tree`). Raises InputError where there is no such program.
    """
    try:
        words = [*shlex.split(command), address]
        if shutil.which(words[0]) is None:
            raise FileNotFoundError(f"no program {words[0]}")
        guard = [sys.executable, "-I", "-S", process_tree.__file__]
        return subprocess.Popen(
            [*guard, *words],
            stdin=subprocess.PIPE,
            stdout=STDERR,
            start_new_session=True,
        )
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise InputError(
            f"ego.command={command}: cannot be started: {error}"
        ) from error


def connect(
    address: str, process: Process | None, deadline: float, name: str
) -> socket.socket:
    """A socket connected to an address, unix:PATH or HOST:PORT, as soon as the planner
    listens."""
    while True:
        try:
            return _connected(address, name)
        except OSError as error:
            if process is not None and process.poll() is not None:
                raise InputError(
                    f"{name}: ended with status {process.returncode} before it listened"
                ) from error
            if time.monotonic() > deadline:
                mend = "start the planner first, or let e2rl start it by ego.command"
                raise InputError(
                    f"{name}: nothing listens at {address} ({error}); {mend}"
                ) from error
        time.sleep(PAUSE)


def _connected(address: str, name: str) -> socket.socket:
    kind, _, rest = address.rpartition(":")
    if kind == "unix":
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(rest)
        except BaseException:
            connection.close()
            raise
        return connection
    if not kind or not rest.isdecimal() or int(rest) > 0xFFFF:
        raise InputError(f"{name}: is no address; give HOST:PORT or unix:PATH")
    connection = socket.create_connection((kind, int(rest)), timeout=GRACE)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def close(connection: socket.socket | None, process: Process | None) -> None:
    """Close a connection and end the planner's process, and those that it started."""
    if connection is not None:
        connection.close()
    if process is None:
        return
    process.terminate()
    try:
        process.wait(process_tree.GRACE + process_tree.PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
    if process.stdin is not None:
        process.stdin.close()
