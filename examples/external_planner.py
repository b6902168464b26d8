"""A planner in a process of its own, for `ego=external`: it follows its route behind
whoever drives ahead of it.

    python evaluate.py ego=external 'ego.command=python examples/external_planner.py'

It needs nothing but Python, and speaks the protocol of docs/guide/planner.md. Given
HOST:PORT instead of unix:PATH, it serves any number of connections until it is stopped.
"""

import math
import socketserver
import struct
import sys

VERSION = 1
HELLO = 1
SCENE = 2
PLAN = 3
ACTION = 5
FAILED = 6
RED, SPACING = 1, 2.0  # state of a light; metres between two points of a route
DESIRED, GAP, HEADWAY, ACCELERATION, BRAKING = (
    10.0,
    4.0,
    1.2,
    1.5,
    3.0,
)  # m/s, m, s, m/s^2, m/s^2


def read_scene(payload):
    """(scene, what is known of it): the route, its speed limits and its stop lines."""
    scene, _index, points = struct.unpack_from("<3I", payload)
    length, width, _ = struct.unpack_from("<3f", payload, 24)
    route = list(
        struct.iter_unpack("<3f", payload[36 : 36 + 12 * points])
    )  # x, y, speed limit
    lines = list(
        struct.iter_unpack("<if", payload[36 + 12 * points : 52 + 12 * points])
    )  # light, metres of route
    return scene, (length, width, route, lines)


def read_plan(payload):
    """Yields (scene, states of the lights, agents, the ego first)."""
    (count,), at = struct.unpack_from("<I", payload), 4
    for _ in range(count):
        scene, _step, agents, lights = struct.unpack_from("<4I", payload, at)
        end = at + 16 + 4 * lights
        states = struct.unpack_from(f"<{lights}I", payload, at + 16)
        at = end + 40 * agents
        yield scene, states, list(struct.iter_unpack("<2I8f", payload[end:at]))


def act(known, lights, agents):
    """Acceleration by the intelligent driver model, yaw rate by pure pursuit of the
    route."""
    length, width, route, lines = known
    _, _, x, y, heading, speed, *_ = agents[0]
    near = min(
        range(len(route)), key=lambda k: (route[k][0] - x) ** 2 + (route[k][1] - y) ** 2
    )
    desired = route[near][2] or DESIRED
    gap = math.inf
    leader = 0.0
    for (
        _,
        _,
        other_x,
        other_y,
        other_heading,
        other_speed,
        other_length,
        other_width,
        _,
        _,
    ) in agents[1:]:
        along, aside = ahead(other_x - x, other_y - y, heading)
        if (
            along > 0
            and abs(aside) < (width + other_width) / 2
            and along - (length + other_length) / 2 < gap
        ):
            gap = along - (length + other_length) / 2
            leader = other_speed * math.cos(other_heading - heading)
    for light, line in lines:
        to_line = line - SPACING * near - length / 2
        if light >= 0 and lights[light] == RED and 0 < to_line < gap:
            gap = to_line
            leader = 0.0
    wanted = GAP + max(
        0.0,
        speed * HEADWAY
        + speed * (speed - leader) / (2 * math.sqrt(ACCELERATION * BRAKING)),
    )
    push = 1 - (speed / desired) ** 4 - (wanted / max(gap, 0.1)) ** 2
    goal = route[min(near + 2 + int(speed / SPACING), len(route) - 1)]
    along, aside = ahead(goal[0] - x, goal[1] - y, heading)
    return max(ACCELERATION * push, -8.0), 2 * speed * aside / max(
        along**2 + aside**2, 1.0
    )


def ahead(x, y, heading):
    """Metres ahead and to the left of a vehicle that looks along heading."""
    cos = math.cos(heading)
    sin = math.sin(heading)
    return cos * x + sin * y, cos * y - sin * x


class Connection(socketserver.StreamRequestHandler):
    """One simulator; each of its worker processes opens a connection of its own."""

    def handle(self):
        scenes = {}
        while header := self.rfile.read(8):
            kind, length = struct.unpack("<II", header)
            payload = self.rfile.read(length)
            if kind == HELLO:
                self.reply(HELLO, struct.pack("<I", VERSION))
            elif kind == SCENE:
                scene, known = read_scene(payload)
                scenes[scene] = known
            elif kind == PLAN:
                for scene, lights, agents in read_plan(payload):
                    try:
                        self.reply(
                            ACTION,
                            struct.pack(
                                "<I2f", scene, *act(scenes[scene], lights, agents)
                            ),
                        )
                    except (
                        ArithmeticError,
                        LookupError,
                        ValueError,
                    ) as error:  # ends this scene's rollout only
                        self.reply(
                            FAILED,
                            struct.pack("<I", scene) + repr(error).encode()[:1000],
                        )

    def reply(self, kind, payload):
        self.wfile.write(struct.pack("<II", kind, len(payload)) + payload)


class Unix(socketserver.ThreadingMixIn, socketserver.UnixStreamServer):
    """Listens at a path."""


def main():
    address = sys.argv[1]
    if address.startswith("unix:"):  # started by e2rl: ends with its connection
        with Unix(address.removeprefix("unix:"), Connection) as server:
            server.handle_request()
    else:
        host, _, port = address.rpartition(":")
        with socketserver.ThreadingTCPServer((host, int(port)), Connection) as server:
            server.serve_forever()


if __name__ == "__main__":
    main()
