"""What a round clones: the recorded egos, evasions that the search found, and a teacher's survived episodes."""

import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from e2rl.ego.base import PLAN_STEPS, Ego
from e2rl.ego.ranking import RankingEgo
from e2rl.errors import InputError
from e2rl.learning.cloning import pairs_of
from e2rl.learning.driving import PoolDriver, episodes_of, filled_batches
from e2rl.learning.imitation import ImitationSettings, recorded_pairs
from e2rl.scene.recording import DT
from e2rl.scene.scene import SceneSet
from e2rl.settings import check_range, settings_of
from e2rl.sim import dynamics
from e2rl.sim.env import SimSettings
from e2rl.sim.world import World
from e2rl.traffic.pool import TrafficPool

BATCH = 32  # rows driven at once: a round has few that a teacher drives


@dataclass(frozen=True)
class TeachingSettings:
    """Fields: `teaching` in conf/learner/ppo_bc.yaml."""

    rows: int = 32
    candidates: int = 16
    temperature: float = 0.5

    def __post_init__(self) -> None:
        check_range("learner.teaching.rows", self.rows, 1)
        check_range("learner.teaching.candidates", self.candidates, 1)
        check_range("learner.teaching.temperature", self.temperature, 1e-6)


class GivenActions(Ego):
    """Executes actions [B, T, 2] of single steps, in the mean over each decision of `hold` steps."""

    def __init__(self, actions: Tensor, hold: int) -> None:
        super().__init__(PLAN_STEPS)
        self.actions, self.hold = actions, hold

    def plan(self, world: World) -> Tensor:
        """States [B, PLAN_STEPS, 4] at constant velocity: the plan is not followed."""
        times = DT * torch.arange(1, PLAN_STEPS + 1, device=world.states.device)
        return dynamics.constant_velocity(world.states[:, 0], times)

    def act(self, world: World, observation: Tensor, plan: Tensor) -> Tensor:
        """The mean [B, 2] of the next `hold` actions; the last ones are repeated."""
        actions = self.actions.to(world.states.device)
        at = world.step[:, None] + torch.arange(self.hold, device=world.step.device)
        row = torch.arange(len(at), device=at.device)[:, None]
        return actions[row, at.clamp(max=actions.shape[1] - 1)].mean(1)


def evasion_pairs(driver: PoolDriver, pool: TrafficPool, number: int) -> TensorDict | None:
    """Pairs [M] of the evasions in the traffic of pool.parts[number]; None without any.

    Each is driven from the start in its traffic, by decisions of the driver's environments. Of those that end without
    contact on the road, the decisions within their span are kept.
    """
    rows, actions, span = pool.evaded(number)
    hold = driver.env.hold
    parts: list[TensorDict] = []
    for picked, once in batches(len(rows), driver):
        frames = driver.drive(GivenActions(actions[picked], hold), pool, rows[picked])
        step = hold * torch.arange(frames.shape[1])
        acts = (step >= span[picked, :1]) & (step < span[picked, 1:])
        survived = ~episodes_of(frames, pool, rows[picked]).failed
        kept = frames["alive"] & (acts & (survived & once)[:, None]).to(frames.device)
        action = frames["executed"][:, :, None]
        parts.append(pairs_of(frames, kept, pool.scene_index[rows[picked]], driver.env, action))
    return torch.cat(parts) if parts else None


def corrective_pairs(
    driver: PoolDriver, teacher: Ego, pool: TrafficPool, settings: TeachingSettings | None = None
) -> TensorDict:
    """Pairs [M] of the teacher's episodes in the pool's fresh adversarial rows (`taught`) that it survives (Algorithm
    1's corrective supervision); empty if it survives none.

    A RankingEgo's labels are the actions of its cheapest candidates, weighted by softmax(-cost / temperature);
    another's is the action executed.
    """
    settings = settings or TeachingSettings()
    chosen = taught(pool, settings.rows)
    parts: list[TensorDict] = []
    for picked, once in batches(len(chosen), driver):
        rows = chosen[picked]
        frames = driver.drive(teacher, pool, rows, choices=settings.candidates)
        survived = ~episodes_of(frames, pool, rows).failed & once
        kept = frames["alive"] & survived.to(frames.device)[:, None]
        action, weight = frames["executed"][:, :, None], None
        if isinstance(teacher, RankingEgo):
            action, weight = frames["choices"], torch.softmax(-frames["costs"] / settings.temperature, -1)
        parts.append(pairs_of(frames, kept, pool.scene_index[rows], driver.env, action, weight))
    if not parts:
        raise InputError("corrective supervision: the pool holds no fresh adversarial traffic")
    return torch.cat(parts)


def batches(count: int, driver: PoolDriver) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows 0..count-1 in batches [B] of the driver's environments, and bool [B]: not there to fill up the last one."""
    for number, picked in enumerate(filled_batches(count, driver.env.batch_size[0])):
        yield picked, torch.arange(len(picked)) + number * len(picked) < count


def taught(pool: TrafficPool, most: int) -> Tensor:
    """At most `most` fresh adversarial rows of stored traffic, those first in which the policy was hit."""
    rows = (pool.adversarial & pool.fresh & (pool.source >= 0)).nonzero()[:, 0]
    hit = torch.cat([part.span for part in pool.parts])[pool.source[rows], 1] > 0 if len(rows) else rows > 0
    return torch.cat([rows[hit], rows[~hit]])[:most]


class Teachers:
    """The pairs of a round by kind. Those of an evasion are made once and kept for as long as its row is remembered."""

    def __init__(
        self,
        scenes: SceneSet,
        sim: SimSettings,
        hold: int,
        device: str = "cpu",
        recorded: ImitationSettings | None = None,
        evasions: bool = False,
        teacher: Ego | None = None,
        teaching: Mapping[str, Any] | None = None,
    ) -> None:
        """hold: steps of the policy's decisions, by which evasions are driven, and a RankingEgo, which plans at each;
        other teachers track a plan and decide every step. recorded: how pairs of the recorded egos are made, None: they
        are not cloned; others: conf/learner/ppo_bc.yaml."""
        self.teacher = teacher
        self.teaching = settings_of(TeachingSettings, teaching or {}, "learner.teaching")
        self.recorded = None if recorded is None else recorded_pairs(scenes, sim, recorded)
        self._by_decision = PoolDriver(scenes, sim, BATCH, device, hold) if evasions else None
        pace = hold if isinstance(teacher, RankingEgo) else 1
        self._driver = None if teacher is None else PoolDriver(scenes, sim, BATCH, device, pace)
        self._evaded: list[tuple[weakref.ref[Tensor], TensorDict | None]] = []

    def pairs(self, pool: TrafficPool) -> dict[str, TensorDictBase]:
        """Pairs [M], M >= 1, by kind: recorded, evasions, teacher; kinds without any are left out."""
        found: dict[str, TensorDictBase | None] = {"recorded": self.recorded, "evasions": self._of_evasions(pool)}
        if self.teacher is not None and self._driver is not None and len(taught(pool, 1)):
            found["teacher"] = corrective_pairs(self._driver, self.teacher, pool, self.teaching)
        return {kind: pairs for kind, pairs in found.items() if pairs is not None and len(pairs)}

    def _of_evasions(self, pool: TrafficPool) -> TensorDictBase | None:
        """Pairs of all evasions in the pool, remembered rows included."""
        if self._by_decision is None:
            return None
        now = []
        for number, part in enumerate(pool.parts):
            made = [pairs for of, pairs in self._evaded if of() is part.evasion]
            pairs = made[0] if made else evasion_pairs(self._by_decision, pool, number)
            now.append((weakref.ref(part.evasion), pairs))
        self._evaded = now
        every = [pairs for _, pairs in now if pairs is not None]
        return torch.cat(every) if every else None
