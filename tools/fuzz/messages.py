"""Readers of what other programs send."""

import json
import random
import socket
import struct

import torch

from e2rl.planners.ego import PlannerError
from e2rl.planners.external import ExternalEgo, drivable, plans_of
from e2rl.planners.planner_link import ACTION, FAILED, TRAJECTORY, PlannerLink, message
from e2rl.run.errors import InputError
from e2rl.traffic.e2.reasoner import CRITERIA, read_answer
from tools.fuzz.damage import PLAIN, damaged, mutated
from tools.fuzz.garbage import require
from tools.fuzz.inputs import Inputs


class Messages(Inputs):
    def planner_replies(self, draw: random.Random) -> None:
        """Bytes that an outside planner answers with: plans that a vehicle can drive, or a planner that failed."""
        now = torch.tensor([[0.0, 0.0, 0.3, 8.0], [5.0, 1.0, -2.0, 0.0], [9.0, 9.0, 0.0, 20.0]])
        ours, theirs = socket.socketpair()
        link = PlannerLink.__new__(PlannerLink)
        link._buffer, link._socket, link._process, link._name = bytearray(), ours, None, "input"
        link.close = ours.close
        ego = ExternalEgo(command="true", timeout=0.05)
        ego._link = link
        theirs.sendall(replies(draw))
        if draw.random() < 0.9:
            theirs.shutdown(socket.SHUT_WR)
        try:
            plans = plans_of(now, ego._ask(b"x", len(now)), 5)
        except PlannerError as error:
            require(all(0 <= row < len(now) for row in error.rows), "a scene that was not asked for")
            raise InputError(str(error)) from error
        finally:
            ours.close(), theirs.close()
        whole = torch.full((len(now),), plans.shape[1])
        require(bool(drivable(now, plans, whole).all()), "a plan that no vehicle drives")

    def reasoner_answers(self, draw: random.Random) -> None:
        """Answers of a language model, and those in its cache."""
        entries = [{"id": k, **{name: draw.random() < 0.5 for name in CRITERIA}} for k in (3, 5, 8)]
        whole = {"vehicles": entries}
        text = json.dumps(mutated(whole, draw, PLAIN)) if draw.random() < 0.6 else None
        text = text or damaged(json.dumps(whole).encode(), draw).decode(errors="replace")
        try:
            found = read_answer(text, [3, 5, 8])
        except ValueError as error:  # what its caller falls back at
            raise InputError(str(error)) from error
        require(
            all(type(flag) is bool for flags in found.values() for flag in flags), "a verdict that is no truth value"
        )
        require(sorted(found) == [3, 5, 8], "vehicles that were not asked about")


def replies(draw: random.Random) -> bytes:
    """A planner's answers for three scenes."""
    parts, whole = [], draw.random() < 0.3
    for row in [0, 1, 2] if whole else draw.choice([[2, 0, 1], [0, 0, 1], [0, 1], [0, 1, 7], [0, 1, 2, 2]]):
        scene = struct.pack("<I", row)
        odd = draw.choice([0.0, 1e9, float("nan"), -3.0, float("inf"), 0.5])
        kind = ACTION if whole else draw.choice([ACTION, ACTION, TRAJECTORY, TRAJECTORY, FAILED, 0, 99])
        count = draw.choice([50, 5, 4, 0, 10])
        if kind == TRAJECTORY:
            states = [(0.1 * k, odd, 0.0, 1.0) for k in range(count)]
            payload = struct.pack("<I", draw.choice([count, count, 2**31])) + b"".join(
                struct.pack("<4f", *s) for s in states
            )
        elif kind == ACTION:
            payload = struct.pack("<2f", odd, 0.1)
        else:
            payload = b"lost \xff"
        parts.append(message(kind, scene + payload))
    content = b"".join(parts)
    return damaged(content, draw) if draw.random() < 0.5 else content
