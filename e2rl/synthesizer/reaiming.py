"""Re-aiming: vehicles of replayed traffic leave it at a random moment and re-aim at the ego every 0.5 s.

A policy that trains on replayed attacks learns where the adversary will not be. One that re-aims must be reacted to.
Here: in which episodes, who, and from when on; `aim` has the law.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from e2rl.errors import InputError
from e2rl.scene.recording import DT
from e2rl.settings import check_choice, check_range
from e2rl.sim.arc import along_arc
from e2rl.sim.world import World
from e2rl.synthesizer.aim import Ground, Law, surroundings
from e2rl.synthesizer.responsibility import RESPONSIBILITIES, leading
from e2rl.traffic.reaction import Motion, NewEpisodes, Reaction
from e2rl.traffic.traffic import REPLAN_STEPS

NEAR, MOVING = 50.0, 1.0  # m from the ego and m/s: other vehicles that may react
LATEST = 0.6  # share of the episode in which vehicles begin to react
MOST = 2  # vehicles that react in an episode
NEVER = 1 << 30


@dataclass(frozen=True)
class ReactSettings:
    """Fields: `react` in conf/learner/ppo_bc.yaml."""

    share: float = 0.75
    others: float = 0.35
    eta: tuple[float, float] = (1.0, 3.0)
    scatter: float = 0.7
    responsibility: str = "full"
    reckless: float = 0.5

    def __post_init__(self) -> None:
        for name in ("share", "others", "reckless"):
            check_range(f"learner.react.{name}", getattr(self, name), 0, 1)
        check_range("learner.react.scatter", self.scatter, 0)
        check_choice("learner.react.responsibility", self.responsibility, RESPONSIBILITIES)
        if not 0 <= self.eta[0] <= self.eta[1]:
            raise InputError(f"learner.react.eta={list(self.eta)}: expected the lowest and the highest intensity")


def drawn(settings: ReactSettings, episodes: NewEpisodes, generator: torch.Generator) -> TensorDict:
    """The part of the traffic in b new episodes: start [b]: step from which on vehicles react (NEVER: they do not), eta
    [b], count [b] of them, others [b] bool: not the traffic's own adversaries; reckless [b] bool: they owe the ego
    nothing; rank [b, V]: random, the lowest react; adversaries [b, V]; vehicle [b, MOST] and acts [b, MOST]: who they
    are, nobody yet; chosen [b]."""
    size, device = episodes.adversaries.shape, episodes.adversaries.device
    draws = torch.rand(size[0], 6 + size[1], generator=generator).to(device)
    reacts, others, when, how, many, reckless = draws[:, :6].unbind(1)
    start = (when * LATEST * episodes.horizon).long()
    low, high = settings.eta
    nobody = torch.zeros(size[0], MOST, dtype=torch.int64, device=device)
    part = {
        "start": torch.where(episodes.adversarial & (reacts < settings.share), start, NEVER),
        "eta": low + (high - low) * how,
        "count": 1 + (many * MOST).long(),
        "others": others < settings.others,
        "reckless": reckless < settings.reckless,
        "rank": draws[:, 6:],
        "adversaries": episodes.adversaries,
        "vehicle": nobody,
        "acts": nobody.bool(),
        "chosen": torch.zeros_like(start, dtype=torch.bool),
    }
    return TensorDict(part, batch_size=size[:1], device=device)


def chosen(part: TensorDict, world: World, responsibility: str) -> tuple[Tensor, Tensor]:
    """Vehicles [b, MOST] that begin to react now and which of them there are [b, MOST]: present adversaries of the
    traffic, or others that move near the ego; with full responsibility none of these that lead the ego's way."""
    vehicles = part["rank"].shape[1]
    states = world.states[:, :vehicles]
    present = world.valid[:, :vehicles].clone()
    present[:, 0] = False
    near = (states[..., :2] - world.states[:, :1, :2]).norm(dim=-1) < NEAR
    own, others = present & part["adversaries"], present & near & (states[..., 3] > MOVING)
    if responsibility == "full":
        others &= ~leading(world, vehicles)
    others &= ~part["adversaries"]
    first = torch.where((part["others"] & others.any(1))[:, None], others, own)
    first = torch.where(first.any(1)[:, None], first, others)
    found = part["rank"].masked_fill(~first, torch.inf).topk(min(MOST, vehicles), largest=False)
    taken = torch.arange(found.values.shape[1], device=states.device) < part["count"][:, None]
    return found.indices, taken & (found.values < torch.inf)


class Reaiming(Reaction):
    """Vehicles of replayed adversarial episodes that re-aim, as the settings say; draws from a generator of its own."""

    def __init__(self, settings: ReactSettings, seed: int = 0, law: Law | None = None) -> None:
        self.settings, self.generator = settings, torch.Generator().manual_seed(seed)
        self.law = law or Law(settings.responsibility)
        self._part: TensorDict | None = None  # [B] `drawn`

    @property
    def acting(self) -> Tensor:
        assert self._part is not None
        marks = torch.zeros_like(self._part["adversaries"])
        return marks.scatter(1, self._part["vehicle"], self._part["acts"])

    def begin(self, episodes: NewEpisodes) -> None:
        part = drawn(self.settings, episodes, self.generator)
        if self._part is None or len(part) == episodes.batch:
            self._part = part  # the first reset is of all environments
        else:
            self._part[episodes.rows] = part

    @torch.no_grad()
    def react(self, world: World) -> Motion | None:
        part = self._part
        assert part is not None
        due = ~part["chosen"] & (part["start"] <= world.step)
        if bool(due.any()):
            vehicle, acts = chosen(part, world, self.law.responsibility)
            part["vehicle"] = torch.where(due[:, None], vehicle, part["vehicle"])
            part["acts"] = part["acts"] | (acts & due[:, None])
            part["chosen"] = part["chosen"] | due
        row, slot = part["acts"].nonzero(as_tuple=True)
        if not len(row):
            return None
        agents = part["vehicle"][row, slot]
        shift = self.settings.scatter * torch.randn(len(row), 2, generator=self.generator).to(row.device)
        ground, seen = Ground(world.scene["field"], world.scene["field_origin"], row), surroundings(world, row, agents)
        aim = self.law(seen, part["eta"][row], shift, ground, part["reckless"][row])
        times = DT * torch.arange(1, 2 * REPLAN_STEPS + 1, device=row.device)
        states, _ = along_arc(seen.states[:, 1], aim, times)
        return Motion(row, agents, states)
