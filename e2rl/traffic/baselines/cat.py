"""CAT (Zhang et al. 2023): of likely futures, that which overlaps most with the ego's recent ways."""

import torch
from torch import Tensor

from e2rl.prior.prior import Context, Prior
from e2rl.run.settings import check_range
from e2rl.scenes.boxes import overlap
from e2rl.sim.world import World
from e2rl.traffic.baselines.baseline import Answer, replay_others
from e2rl.traffic.baselines.open_loop import OpenLoop, OpenLoopState, Scenario
from e2rl.traffic.baselines.view import folded, motion_of, pick, tiled
from e2rl.traffic.grouping import Group
from e2rl.traffic.traffic import TrafficPlan

STRIDE = 2  # steps between the moments at which boxes are compared
DECAY = 0.99  # of a contact's worth, a step


class CAT(OpenLoop):
    """Candidates: joint samples of the prior; the chosen future of a vehicle is driven open loop, others replay."""

    def __init__(
        self,
        prior: Prior,
        knowledge: str = "plan",
        prediction: str = "prior",
        responsibility: str = "none",
        gain: float = 16.0,
        samples: int = 32,
        spread: float = 2.0,
        ways: int = 5,
    ) -> None:
        """Fields: conf/synthesizer/cat.yaml."""
        super().__init__(prior, knowledge, prediction, responsibility, gain, samples)
        check_range("synthesizer.ways", ways, 1, samples)
        check_range("synthesizer.spread", spread, 0)
        self.spread, self.ways, self.queries_ego = spread, ways, knowledge == "plan"

    def replan(
        self, state: OpenLoopState, world: World, ego_plan: Tensor, react: Answer | None = None
    ) -> tuple[OpenLoopState, TrafficPlan]:
        """States and plans of the coming HORIZON steps; all but the adversary replay, in scenes with strength."""
        state, plan = super().replan(state, world, ego_plan, react)
        return replay_others(state, plan, world, state.held | (self.strength(state) <= 0)[:, None])

    def scenario(
        self,
        state: OpenLoopState,
        world: World,
        ego_plan: Tensor,
        noise: Tensor,
        group: Group,
        context: Context,
        nominal: Tensor,
    ) -> Scenario:
        """The nominal sample with the future of greatest overlap in its vehicle's row, which alone is held."""
        count, vehicles = noise.shape[3], context.active.shape[1]
        many = tiled(context, count)
        wide = torch.cat([noise[..., :1, :], self.spread * noise[..., 1:, :]], 3)  # the first is the nominal one
        x0 = self.prior.sample(many, folded(wide)).x0
        futures = motion_of(self.prior, x0, many, count, slice(None)).states()
        ways = self.recent_ways(state, world, ego_plan, noise, group, futures)
        value = overlap_value(futures, ways, world.scene["size"][:, :vehicles]) * context.active
        tried = torch.arange(count, device=value.device)[:, None] < self.strength(state).round().clamp(min=1)
        best, at = (value * tried[..., None]).transpose(0, 1).flatten(1).max(-1)
        adversary = torch.arange(vehicles, device=at.device) == (at % vehicles)[:, None]
        adversary = adversary & (best > 0)[:, None]
        chosen = pick(x0.unflatten(0, (count, -1)), at // vehicles)
        x = torch.where(adversary[..., None], chosen, nominal)
        return Scenario(x, adversary, adversary, torch.zeros_like(state.path_kl))

    def recent_ways(
        self, state: OpenLoopState, world: World, ego_plan: Tensor, noise: Tensor, group: Group, futures: Tensor
    ) -> Tensor:
        """Motions [ways, B, HORIZON, 4] of the ego: its policy driven against nominal futures [S, B, V, HORIZON, 4], or
        samples of the prior where its plan is not known."""
        if self.knowledge == "plan":
            if self._react is None:
                return ego_plan[None, :, : futures.shape[-2]]
            return torch.stack([self._react(group.rows, one) for one in futures[: self.ways]])
        free = self.prior.encode(state.routed, state.lane, world.states, world.valid, world.step, None)
        many = tiled(free, self.ways)
        x0 = self.prior.sample(many, folded(noise[..., : self.ways, :])).x0
        return motion_of(self.prior, x0, many, self.ways, slice(None)).states()[:, :, 0]


def overlap_value(futures: Tensor, ways: Tensor, size: Tensor) -> Tensor:
    """Mean over the ego's ways [W, B, H, 4] of DECAY^step of the first contact with futures [S, B, V, H, 4], 0 without
    one: [S, B, V]. size [B, V, 2]."""
    own, ego = futures[..., STRIDE - 1 :: STRIDE, :], ways[..., STRIDE - 1 :: STRIDE, :]
    boxes = own[:, None], size[:, :, None], ego[None, :, :, None], size[:, :1, None]
    worth = DECAY ** (STRIDE * torch.arange(1, own.shape[-2] + 1, device=own.device))
    return (overlap(*boxes) * worth).amax(-1).mean(1)
