"""The connection to a planner outside of e2rl, and the process that it runs in where
e2rl starts it (messages: planner_messages.py)."""

import shlex
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import time
from multiprocessing.util import Finalize

from e2rl.planners.ego import PLAN_STEPS
from e2rl.planners.planner_messages import (
    HEADER,
    HELLO,
    MAX_REPLY,
    VERSION,
    BadReply,
    message,
)
from e2rl.run import guard
from e2rl.run.errors import InputError
from e2rl.scenes.recording import DT

STDERR = 2  # file descriptor
PAUSE = 0.02  # s between two attempts to connect
ANSWERS = 5.0  # s in which a planner that runs takes a connection
GRACE = 1.0  # s that a connection, or the end of a process, may take
PATIENCE = 5.0  # s in which a killed process ends
RECEIVED = 1 << 16  # bytes taken from the socket at a time
Process = subprocess.Popen[bytes]


class PlannerLink:
    """A connection over which greetings were exchanged; of the process that opened it,
    in which it is closed with the link's last reference, or at the end."""

    def __init__(
        self,
        command: str | None,
        address: str | None,
        *,
        replan_every: int,
        timeout: float,
    ) -> None:
        """Start a planner, or connect to one that runs.

        Args:
            command: starts it, with the address to listen at as its last argument.
            address: HOST:PORT or unix:PATH of one that runs, without a command.
            replan_every: steps between two plans, which the planner is told.
            timeout: s within which it listens and greets.

        Raises:
            InputError: none answers in time.
        """
        self.buffer = bytearray()
        """What came beyond the last message taken."""
        self._process = None
        start_time = time.monotonic()
        deadline = start_time + timeout
        try:
            if command is None:
                self._name = f"ego.address={address}"
                patience = min(timeout, ANSWERS)
                self._socket = self._connect(str(address), start_time + patience)
            else:  # a connection does not need its path
                self._name = f"ego.command={command}"
                with tempfile.TemporaryDirectory(
                    prefix="e2rl-", ignore_cleanup_errors=True
                ) as folder:
                    path = f"unix:{folder}/planner"
                    self._process = start(command, path)
                    self._socket = self._connect(path, deadline)
        except BaseException:
            close(None, self._process)
            raise
        self.close = Finalize(
            self,
            close,
            (self._socket, self._process),
            exitpriority=10,
        )
        self._greet(replan_every, deadline)

    def _connect(self, address: str, deadline: float) -> socket.socket:
        """A socket connected to an address as soon as the planner listens."""
        while True:
            try:
                return connected(address, self._name)
            except OSError as error:
                process = self._process
                if process is not None and process.poll() is not None:
                    status = process.returncode
                    raise InputError(
                        f"{self._name}: ended with status {status} before it listened"
                    ) from error
                if time.monotonic() > deadline:
                    raise InputError(
                        f"{self._name}: nothing listens at {address} ({error}); start "
                        "the planner first, or let e2rl start it by ego.command"
                    ) from error
            time.sleep(PAUSE)

    def _greet(self, replan_every: int, deadline: float) -> None:
        try:
            about = struct.pack("<IfII", VERSION, DT, PLAN_STEPS, replan_every)
            self.send(message(HELLO, about), deadline)
            kind, payload = self.receive(deadline)
            if kind != HELLO or len(payload) != 4:
                raise BadReply(
                    f"its first message is of kind {kind} and {len(payload)} bytes, "
                    "not HELLO of 4"
                )
            (version,) = struct.unpack("<I", payload)
            if version != VERSION:
                raise BadReply(f"it speaks version {version}, e2rl version {VERSION}")
        except (OSError, EOFError, BadReply) as error:
            self.close()
            raise InputError(
                f"{self._name}: no planner answers there: {error or 'no HELLO in time'}"
            ) from error

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
                f"a message of kind {kind} announces {length} bytes; replies have at "
                f"most {MAX_REPLY}"
            )
        return kind, self._take(length, deadline)

    def _take(self, count: int, deadline: float) -> bytes:
        while len(self.buffer) < count:
            remaining = deadline - time.monotonic()
            if remaining <= 0:
                raise TimeoutError("no reply in time")
            self._socket.settimeout(remaining)
            part = self._socket.recv(RECEIVED)
            if not part:
                raise EOFError("it closed the connection")
            self.buffer += part
        head = bytes(self.buffer[:count])
        del self.buffer[:count]
        return head

    def ending(self) -> str:
        """How the planner's process ended, as far as is known."""
        if self._process is None:
            return "the connection broke"
        try:
            status = self._process.wait(GRACE)
        except subprocess.TimeoutExpired:
            return "it closed the connection"
        return f"its process ended with status {status} (what it said is on stderr)"


def start(command: str, address: str) -> Process:
    """The process of a command, which is given the address to listen at.

    It ends with this process, with all of its process group
    (`e2rl.run.guard`). Raises InputError where there is no such program.
    """
    try:
        words = [*shlex.split(command), address]
        if shutil.which(words[0]) is None:
            raise FileNotFoundError(f"no program {words[0]}")
        return subprocess.Popen(
            [
                sys.executable,
                "-I",
                "-S",
                guard.__file__,
                *words,
            ],
            stdin=subprocess.PIPE,
            stdout=STDERR,
            start_new_session=True,
        )
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise InputError(
            f"ego.command={command}: cannot be started: {error}"
        ) from error


def connected(address: str, name: str) -> socket.socket:
    """A socket connected to an address, unix:PATH or HOST:PORT; name: what gave it, for
    the InputError where it is none. Raises OSError where nothing listens."""
    host, _, port = address.rpartition(":")
    if host == "unix":
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(port)
        except BaseException:
            connection.close()
            raise
        return connection
    if not host or not port.isdecimal() or int(port) > 0xFFFF:
        raise InputError(f"{name}: is no address; give HOST:PORT or unix:PATH")
    connection = socket.create_connection((host, int(port)), timeout=GRACE)
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
        process.wait(guard.GRACE + PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
    if process.stdin is not None:
        process.stdin.close()
