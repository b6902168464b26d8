"""What a round clones: the recorded egos, and evasions that the search found."""

import weakref

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from e2rl.learning.cloning import demonstrations_of
from e2rl.learning.driving import PoolDriver, episodes_of, filled_batches
from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.scenes.recording import DT
from e2rl.scenes.scene import SceneSet
from e2rl.sim import dynamics
from e2rl.sim.env import SimSettings
from e2rl.sim.world import World
from e2rl.traffic.pool import TrafficPool

BATCH = 32  # rows driven at once: a round has few with an evasion


class GivenActions(Ego):
    """Executes actions [B, T, 2] of single steps, in the mean over each decision of
    `hold` steps."""

    def __init__(self, actions: Tensor, hold: int) -> None:
        super().__init__(PLAN_STEPS)
        self.actions = actions
        self.hold = hold

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


def evasion_demonstrations(
    driver: PoolDriver, pool: TrafficPool, number: int
) -> TensorDict | None:
    """Demonstrations [M] of the evasions in the traffic of pool.parts[number]; None
    without any.

    Each is driven from the start in its traffic, by decisions of the driver's
    environments. Of those that end without contact on the road, the decisions within
    their span are kept.
    """
    rows, actions, span = pool.evaded(number)
    hold = driver.env.hold
    parts: list[TensorDict] = []
    batch = driver.env.batch_size[0]
    for turn, picked in enumerate(filled_batches(len(rows), batch)):
        once = torch.arange(batch) + turn * batch < len(
            rows
        )  # not there to fill up the last batch
        frames = driver.drive(GivenActions(actions[picked], hold), pool, rows[picked])
        step = hold * torch.arange(frames.shape[1])
        acts = (step >= span[picked, :1]) & (step < span[picked, 1:])
        survived = ~episodes_of(frames, pool, rows=rows[picked]).failed
        kept = frames["alive"] & (acts & (survived & once)[:, None]).to(frames.device)
        action = frames["executed"][:, :, None]
        parts.append(
            demonstrations_of(
                frames,
                kept,
                scene_index=pool.scene_index[rows[picked]],
                env=driver.env,
                action=action,
            )
        )
    return torch.cat(parts) if parts else None


class Experts:
    """The demonstrations of a round by kind. Those of an evasion are made once and kept
    while its row is remembered."""

    def __init__(
        self,
        scenes: SceneSet,
        sim: SimSettings,
        hold: int,
        device: str = "cpu",
        recorded: TensorDict | None = None,
        evasions: bool = False,
    ) -> None:
        """hold: steps of the policy's decisions, by which evasions are driven;
        recorded: demonstrations of the recorded egos; evasions: clone those in the
        pool's traffic."""
        self.recorded = recorded
        self._driver = (
            PoolDriver(scenes, sim, batch=BATCH, device=device, hold=hold)
            if evasions
            else None
        )
        self._evaded: list[tuple[weakref.ref[Tensor], TensorDict | None]] = []

    def demonstrations(self, pool: TrafficPool) -> dict[str, TensorDictBase]:
        """Demonstrations [M], M >= 1, by kind: recorded, evasions; kinds without any
        are left out."""
        found: dict[str, TensorDictBase | None] = {
            "recorded": self.recorded,
            "evasions": self._of_evasions(pool),
        }
        return {
            kind: shown
            for kind, shown in found.items()
            if shown is not None and len(shown)
        }

    def _of_evasions(self, pool: TrafficPool) -> TensorDictBase | None:
        """Demonstrations of all evasions in the pool, remembered rows included."""
        if self._driver is None:
            return None
        now = []
        for number, part in enumerate(pool.parts):
            made = [shown for of, shown in self._evaded if of() is part.evasion]
            shown = (
                made[0]
                if made
                else evasion_demonstrations(self._driver, pool, number=number)
            )
            now.append((weakref.ref(part.evasion), shown))
        self._evaded = now
        every = [shown for _, shown in now if shown is not None]
        return torch.cat(every) if every else None
