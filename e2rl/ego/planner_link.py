"""The connection to a planner outside of e2rl, and the process that it runs in where e2rl starts it."""

import os
import shlex
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from functools import partial
from multiprocessing.util import Finalize

from e2rl.ego.planner_messages import HEADER, MAX_REPLY, VERSION, Malformed, hello, read_version
from e2rl.errors import InputError
from e2rl.workers import die_with_parent

STDERR = 2  # file descriptor
PAUSE = 0.02  # s between two attempts to connect
GRACE = 1.0  # s between SIGTERM and SIGKILL
Process = subprocess.Popen[bytes]


class PlannerLink:
    """A connection over which greetings were exchanged; of the process that opened it, in which it is closed with the
    link's last reference, or at the end."""

    def __init__(self, command: str | None, address: str | None, replan_every: int, timeout: float) -> None:
        """Start `command` with an address as its last argument, or connect to the `address` of a planner that runs.

        Raises InputError where none answers within `timeout` s.
        """
        self._buffer = bytearray()
        self._name = f"ego.address={address}" if command is None else f"ego.command={command}"
        folder = None if command is None else tempfile.mkdtemp(prefix="e2rl-")
        self._process, deadline = None, time.monotonic() + timeout
        try:
            if command is not None:
                address = f"unix:{folder}/planner"
                self._process = start(command, address)
            self._socket = connect(str(address), self._process, deadline, self._name)
        except BaseException:
            end(self._process)
            raise
        finally:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)  # a connection does not need its path
        self.close = Finalize(self, close, (self._socket, self._process), exitpriority=10)
        self._greet(replan_every, deadline)

    def _greet(self, replan_every: int, deadline: float) -> None:
        try:
            self.send(hello(replan_every), deadline)
            version = read_version(*self.receive(deadline))
        except (OSError, EOFError, Malformed) as error:
            self.close()
            raise InputError(f"{self._name}: no planner answers there: {error or 'no HELLO in time'}") from error
        if version != VERSION:
            self.close()
            raise InputError(f"{self._name}: the planner speaks version {version} of the protocol, e2rl {VERSION}")

    def send(self, content: bytes, deadline: float) -> None:
        """Send messages. Raises TimeoutError, or OSError where the connection broke."""
        self._socket.settimeout(max(deadline - time.monotonic(), PAUSE))
        self._socket.sendall(content)

    def receive(self, deadline: float) -> tuple[int, bytes]:
        """Kind and payload of the next message. Raises TimeoutError; EOFError or OSError where the connection broke;
        Malformed where the payload is longer than any reply's."""
        kind, length = HEADER.unpack(self._take(HEADER.size, deadline))
        if length > MAX_REPLY:
            raise Malformed(f"a message of kind {kind} announces {length} bytes; replies have at most {MAX_REPLY}")
        return kind, self._take(length, deadline)

    def _take(self, count: int, deadline: float) -> bytes:
        while len(self._buffer) < count:
            left = deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError("no reply in time")
            self._socket.settimeout(left)
            part = self._socket.recv(1 << 16)
            if not part:
                raise EOFError("it closed the connection")
            self._buffer += part
        taken = bytes(self._buffer[:count])
        del self._buffer[:count]
        return taken

    @property
    def unread(self) -> int:
        """Bytes that came beyond the last message taken."""
        return len(self._buffer)

    def ending(self) -> str:
        """How the planner's process ended, as far as is known."""
        if self._process is None:
            return "the connection broke"
        try:
            return f"its process ended with status {self._process.wait(GRACE)} (what it said is on stderr)"
        except subprocess.TimeoutExpired:
            return "it closed the connection"


def start(command: str, address: str) -> Process:
    """The process of a command, which is given the address to listen at; on Linux it dies with this one."""
    try:
        return subprocess.Popen(
            [*shlex.split(command), address],
            stdin=subprocess.DEVNULL,
            stdout=STDERR,
            start_new_session=True,  # Ctrl-C is for e2rl, which ends the planner
            preexec_fn=partial(die_with_parent, os.getpid()),
        )
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise InputError(f"ego.command={command}: cannot be started: {error}") from error


def connect(address: str, process: Process | None, deadline: float, name: str) -> socket.socket:
    """A socket connected to an address, unix:PATH or HOST:PORT, as soon as the planner listens."""
    while True:
        try:
            return _connected(address, name)
        except OSError as error:
            if process is not None and process.poll() is not None:
                raise InputError(f"{name}: ended with status {process.returncode} before it listened") from error
            if time.monotonic() > deadline:
                raise InputError(f"{name}: nothing listens at {address} ({error}); start the planner") from error
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


def close(connection: socket.socket, process: Process | None) -> None:
    """Close a connection and end the planner's process, if it is known."""
    connection.close()
    end(process)


def end(process: Process | None) -> None:
    """End a planner's process, and those that it started."""
    if process is None or process.poll() is not None:
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        os.killpg(process.pid, number)
        try:
            process.wait(GRACE)
            return
        except subprocess.TimeoutExpired:
            continue
