"""Who applies the criteria of Sec. IV-A2: the rules of feasibility.py, or a language
model in their place.

The model is asked about all vehicles of a scene in one request, and about the scenes of
a batch in parallel. Answers are cached on disk by content. Where a request fails, the
rules decide for that scene, and this is counted.
"""

import hashlib
import json
import math
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.run.config import configured, library, setting
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.scenes.boxes import to_frame
from e2rl.scenes.recording import LIGHT_GREEN, LIGHT_RED, LIGHT_YELLOW
from e2rl.scenes.route import SPACING, interpolate, project
from e2rl.sim.mission import light_state_at, mission_of
from e2rl.sim.world import World
from e2rl.traffic.e2.feasibility import (
    Conflicts,
    Feasibility,
    FeasibilitySettings,
    feasible_vehicles,
)
from e2rl.traffic.motion import frenet_pose

INSTRUCTIONS = """\
You judge which vehicles in a traffic scene could come into conflict with the ego vehicle within the next five seconds.
You get a description of the ego and of every other vehicle: position and motion seen from the ego, the routes that its
lane offers, and where and when each route meets the ego's route. Judge every vehicle by three criteria, on its own:
- on_lane: it is on the drivable area and belongs to a lane: near the centreline of one of its routes and along it.
- can_meet_ego: one of its routes conflicts with the ego's route or overlaps it, and both can be there at the same time.
- moving_or_blocking: it moves, or it stands in the ego's route closely ahead.
Take the numbers as given and do not guess what is not described. Answer for every vehicle of the list once, by its
number, in the JSON format asked for."""  # noqa: E501

CRITERIA = ("on_lane", "can_meet_ego", "moving_or_blocking")
Verdicts = dict[int, tuple[bool, ...]]  # of each vehicle: the CRITERIA in order


def _object(**properties: dict) -> dict:
    """The JSON schema of an object of exactly these properties."""
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


VEHICLE = _object(
    id={"type": "integer"}, **{name: {"type": "boolean"} for name in CRITERIA}
)
SCHEMA = _object(vehicles={"type": "array", "items": VEHICLE})
FORMAT = {
    "type": "json_schema",
    "json_schema": {"name": "feasibility", "strict": True, "schema": SCHEMA},
}


def messages(ego: str, vehicles: dict[int, str]) -> list[dict[str, str]]:
    """The chat of one scene: the instructions, then the descriptions of the ego and of
    each vehicle."""
    listed = "\n".join(f"- {text}" for text in vehicles.values())
    question = f"{ego}\n{listed}\nJudge vehicles {', '.join(map(str, vehicles))}."
    return [
        {"role": "system", "content": INSTRUCTIONS},
        {"role": "user", "content": question},
    ]


def read_answer(text: str, vehicles: list[int]) -> Verdicts:
    """The verdicts in an answer; ValueError where it is not JSON of the schema about
    exactly these vehicles."""
    try:
        entries = json.loads(text)["vehicles"]
        verdicts = {
            entry["id"]: tuple(entry[name] for name in CRITERIA) for entry in entries
        }
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"the answer is not of the schema ({type(error).__name__}: {error})"
        ) from error
    if sorted(map(str, verdicts)) != sorted(map(str, vehicles)) or len(entries) != len(
        vehicles
    ):
        raise ValueError(
            f"the answer is about vehicles {sorted(map(str, verdicts))}, asked was about {vehicles}"
        )
    if not all(
        isinstance(value, bool) for verdict in verdicts.values() for value in verdict
    ):
        raise ValueError("the answer holds something else than true and false")
    return verdicts


LIGHTS = {LIGHT_RED: "red", LIGHT_YELLOW: "yellow", LIGHT_GREEN: "green"}


def _position(local: Tensor) -> str:
    x, y = local.tolist()
    ahead = f"{abs(x):.0f} m {'ahead of' if x >= 0 else 'behind'} it"
    return (
        ahead
        if abs(y) < 1
        else f"{ahead} and {abs(y):.0f} m to its {'left' if y > 0 else 'right'}"
    )


def _heading(turn: float) -> str:
    turn = math.degrees(math.remainder(turn, 2 * math.pi))
    if abs(turn) < 25:
        return "in the ego's direction"
    if abs(turn) > 155:
        return "against the ego's direction"
    return f"turned {abs(turn):.0f} degrees to the {'left' if turn > 0 else 'right'} of the ego"


def _course(route: Tensor, s: Tensor) -> str:
    """Where a route [P, 2] leads within 50 m of arc length s []."""
    _, heading, _ = interpolate(route, s + SPACING * s.new_tensor(range(26)))
    turn = sum(
        math.remainder(b - a, 2 * math.pi)
        for a, b in zip(heading.tolist(), heading.tolist()[1:], strict=False)
    )
    if abs(turn) < 0.4:
        return "goes straight on"
    return f"turns {'left' if turn > 0 else 'right'} by {math.degrees(abs(turn)):.0f} degrees"


def _next_light(
    scene: TensorDictBase,
    step: Tensor,
    vehicle: int,
    candidate: int,
    s: float,
) -> str:
    """The next light on a candidate route of scene [1] at step [1], where it is ahead
    of arc length s and known."""
    ahead = float(scene["route_light_s"][0, vehicle, candidate, 0]) - s
    light = scene["route_light"][:, vehicle, candidate, :1]
    colour = LIGHTS.get(int(light_state_at(scene["light_state"], light, step=step)))
    return f", {colour} light in {ahead:.0f} m" if colour and ahead >= 0 else ""


def describe(
    scene: TensorDictBase,
    world: World,
    conflicts: Conflicts,
    row: int,
) -> tuple[str, dict[int, str]]:
    """Returns the ego of a scene and its mission in words, and every present vehicle
    that is not parked, by its index.

    Args:
        scene: B scenes.
        world: the scenes now.
        conflicts: by the rules.
        row: which scene.
    """
    vehicles = scene["route_points"].shape[1]
    present = (
        (world.valid[row, :vehicles] & ~scene["parked"][row, :vehicles])
        .nonzero()[:, 0]
        .tolist()
    )
    texts = {
        vehicle: describe_vehicle(
            scene,
            world,
            conflicts=conflicts,
            row=row,
            vehicle=vehicle,
        )
        for vehicle in present
        if vehicle > 0
    }
    mission = mission_of(scene[row : row + 1])
    limit = float(mission.limit[0, 10])
    s = project(world.states[row : row + 1, :1, :2], mission.points)[0][0, 0]
    limited = f" (limit {limit:.0f} m/s)" if limit else ""
    course = _course(mission.points[0], s)
    speed = world.states[row, 0, 3]
    return f"The ego drives at {speed:.1f} m/s{limited}; its route {course}.", texts


def describe_vehicle(
    scene: TensorDictBase,
    world: World,
    conflicts: Conflicts,
    row: int,
    vehicle: int,
) -> str:
    """Returns position and motion of a vehicle, and where its routes meet the ego's by
    the rules, whose verdict is not told.

    Args:
        scene: B scenes.
        world: the scenes now.
        conflicts: by the rules.
        row: which scene.
        vehicle: its row.
    """
    rows = slice(row, row + 1)
    here = slice(vehicle, vehicle + 1)
    state = world.states[row, vehicle]
    ego = world.states[row, 0]
    size = scene["size"][row, vehicle].tolist()
    sentences = [
        f"Vehicle {vehicle} ({size[0]:.1f} x {size[1]:.1f} m) is "
        f"{_position(to_frame(state[:2], ego))}, "
        f"{_heading(float(state[2] - ego[2]))}, at {state[3]:.1f} m/s."
    ]
    s, d, error = (
        x[0, 0]
        for x in frenet_pose(
            world.states[rows, here], scene["route_points"][rows, here]
        )
    )
    for candidate in scene["route_valid"][row, vehicle].nonzero()[:, 0].tolist():
        at = (row, vehicle, candidate)
        course = _course(scene["route_points"][at], s[candidate])
        light = _next_light(
            scene[rows],
            world.step[rows],
            vehicle=vehicle,
            candidate=candidate,
            s=float(s[candidate]),
        )
        meeting = "; does not meet the ego's route in time"
        if conflicts.exists[at]:
            meeting = (
                f"; meets the ego's route in {conflicts.s[at] - s[candidate]:.0f} m, "
                "both can be there "
                f"{conflicts.earliest[at]:.1f} to {conflicts.latest[at]:.1f} s from now, "
                f"{conflicts.time_gap[at]:.1f} s apart at present speeds"
            )
        sentences.append(
            f"Route {candidate}: {abs(d[candidate]):.1f} m beside its centreline, turned "
            f"{math.degrees(abs(error[candidate])):.0f} degrees to it; it {course}{light}{meeting}."
        )
    return " ".join(
        sentences if len(sentences) > 1 else [*sentences, "It follows no lane."]
    )


@configured("synthesizer/e2", "reasoner")
@dataclass(frozen=True)
class ReasonerSettings:
    """Settings of the reasoner; conf/synthesizer/e2.yaml explains each."""

    kind: str = setting(choices=("rules", "lm"))
    model: str | None = setting(optional=True)
    base_url: str | None = setting(optional=True)
    timeout: float = setting(low=1e-3)
    retries: int = setting(low=0)
    workers: int = setting(low=1)
    cache: str = setting()

    def __post_init__(self) -> None:
        if self.kind == "lm" and not self.model:
            raise InputError(
                "synthesizer.reasoner.kind=lm: name a model with synthesizer.reasoner.model=NAME"
            )


class LanguageReasoner:
    """Asks an OpenAI-compatible endpoint; called as `feasible_vehicles` is.

    statistics: lm_scenes judged, lm_requests sent, lm_cached answers, lm_fallbacks
    (scenes that the rules decided, the 1st, 10th, 100th, ... with a warning).
    """

    def __init__(self, settings: ReasonerSettings) -> None:
        where = "synthesizer.reasoner.kind=lm"
        openai = library("openai", where, extra="lm")
        try:
            self._client = openai.OpenAI(
                base_url=settings.base_url,
                timeout=settings.timeout,
                max_retries=settings.retries,
            )
        except openai.OpenAIError as error:
            reason = (
                f"{str(error).splitlines()[0]} (for an endpoint without keys any "
                "OPENAI_API_KEY will do)"
            )
            raise InputError(f"{where}: {reason}") from error
        self._failures = (openai.OpenAIError, ValueError)
        self.settings = settings
        self._lock = threading.Lock()
        self.statistics = dict.fromkeys(
            ("lm_scenes", "lm_requests", "lm_cached", "lm_fallbacks"), 0
        )

    def __call__(
        self,
        scene: TensorDictBase,
        world: World,
        settings: FeasibilitySettings,
    ) -> Feasibility:
        """Feasible vehicles of scenes [B]: `mask` by the model's verdicts on the three
        criteria, or the rules' where it fails; never the ego nor parked ones. All else
        is the rules'."""
        rules = feasible_vehicles(scene, world, settings=settings)
        criteria = torch.stack(
            [rules.associated, rules.conflicting, rules.relevant], -1
        ).cpu()
        descriptions = [
            describe(scene, world, conflicts=rules.conflicts, row=row)
            for row in range(len(world.step))
        ]
        with ThreadPoolExecutor(self.settings.workers) as pool:
            answers = pool.map(self._verdicts, descriptions)
            for row, verdicts in enumerate(answers):
                if verdicts:
                    values = torch.tensor(list(verdicts.values()))
                    criteria[row, list(verdicts)] = values
        vehicles = rules.mask.shape[1]
        present = world.valid[:, :vehicles] & ~scene["parked"][:, :vehicles]
        mask = criteria.all(-1).to(rules.mask.device) & present
        mask[:, 0] = False
        return replace(rules, mask=mask)

    def _verdicts(self, scene: tuple[str, dict[int, str]]) -> Verdicts | None:
        """Verdicts on one scene as `describe` has it, from the cache or the endpoint;
        None where both failed."""
        ego, vehicles = scene
        if not vehicles:
            return {}
        self._count("lm_scenes")
        chat = messages(ego, vehicles)
        key = json.dumps(
            [self.settings.base_url, self.settings.model, chat, FORMAT], sort_keys=True
        )
        path = (
            Path(self.settings.cache)
            / f"{hashlib.sha256(key.encode()).hexdigest()}.json"
        )
        with suppress(OSError, ValueError):  # no answer yet, or a damaged one: ask
            verdicts = read_answer(path.read_text(), list(vehicles))
            self._count("lm_cached")
            return verdicts
        try:
            self._count("lm_requests")
            answer = self._ask(chat)
            verdicts = read_answer(answer, list(vehicles))
        except self._failures as error:
            count = self._count("lm_fallbacks")
            if str(count).rstrip("0") == "1":
                reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
                scenes = f"{count} of {self.statistics['lm_scenes']} scenes so far"
                warnings.warn(
                    f"language-model reasoner: the rules decided for {scenes} ({reason})",
                    stacklevel=2,
                )
            return None
        try:
            write_atomically(path, answer)
        except OSError as error:
            where = f"synthesizer.reasoner.cache={path.parent}"
            raise InputError(
                f"{where}: cannot be written ({error}); pass a writable folder"
            ) from error
        return verdicts

    def _ask(self, chat: list[dict[str, str]]) -> str:
        request: dict[str, Any] = {
            "model": self.settings.model,
            "messages": chat,
            "response_format": FORMAT,
        }
        completion = self._client.chat.completions.create(**request, temperature=0)
        if (
            not getattr(completion, "choices", None)
            or not completion.choices[0].message.content
        ):
            raise ValueError("the endpoint sent no answer")
        return completion.choices[0].message.content

    def _count(self, name: str) -> int:
        with self._lock:
            self.statistics[name] += 1
            return self.statistics[name]
