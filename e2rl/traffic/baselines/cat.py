"""CAT (Zhang et al. 2023): of likely futures, the one that overlaps most with the ego's
recent tracks."""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.prior.prior import Context
from e2rl.run.settings import check_range, configured, setting
from e2rl.scenes.boxes import overlap
from e2rl.sim.world import World
from e2rl.traffic.baselines.baseline import replay_others
from e2rl.traffic.baselines.open_loop import OpenLoop, OpenLoopState, Scenario
from e2rl.traffic.baselines.view import folded, motion_of, pick, tiled
from e2rl.traffic.nominal import React, Replan
from e2rl.traffic.traffic import TrafficPlan

STRIDE = 2  # steps between the moments at which boxes are compared
DECAY = 0.99  # of a contact's worth, a step


@configured("synthesizer/cat")
@dataclass(eq=False, repr=False)
class CAT(OpenLoop):
    """Candidates: joint samples of the prior; the chosen future of a vehicle is driven
    open loop, others replay."""

    samples: int = setting(low=1)
    spread: float = setting(low=0)
    tracks: int = setting(low=1)

    tuned = {
        "gain": (0.5, 16.0, "log")
    }  # candidates per unit of eta; nothing is optimised, so there is no step size

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("synthesizer.tracks", self.tracks, low=1, high=self.samples)
        self.queries_ego = self.knowledge == "plan"

    def replan(
        self,
        state: OpenLoopState,
        world: World,
        ego_plan: Tensor,
        react: React | None = None,
    ) -> tuple[OpenLoopState, TrafficPlan]:
        """Returns states and plans of the coming HORIZON steps; with strength all
        replay that have never been adversaries: who has left its recording does not
        return to it."""
        state, plan = super().replan(state, world, ego_plan, react)
        driven = state.held | state.released | (self.strength(state) <= 0)[:, None]
        return replay_others(state, plan, world=world, driven=driven)

    def scenario(self, now: Replan, context: Context, nominal: Tensor) -> Scenario:
        """The nominal sample with the future of greatest overlap in its vehicle's row,
        which alone is held."""
        state = now.state
        noise = now.noise
        count = noise.shape[3]
        vehicles = context.active.shape[1]
        many = tiled(context, count)
        wide = torch.cat(
            [noise[..., :1, :], self.spread * noise[..., 1:, :]], 3
        )  # the first is the nominal one
        x0 = self.prior.sample(many, folded(wide)).x0
        futures = motion_of(
            self.prior, x0, context=many, count=count, steps=slice(None)
        ).states()
        value = overlap_value(
            futures,
            self.recent_tracks(now, futures),
            size=now.world.scene["size"][:, :vehicles],
        )
        value = value * context.active
        tried = torch.arange(count, device=value.device)[:, None] < self.strength(
            state
        ).round().clamp(min=1)
        best, at = (value * tried[..., None]).transpose(0, 1).flatten(1).max(-1)
        adversary = torch.arange(vehicles, device=at.device) == (at % vehicles)[:, None]
        adversary = adversary & (best > 0)[:, None]
        chosen = pick(x0.unflatten(0, (count, -1)), at // vehicles)
        x = torch.where(adversary[..., None], chosen, nominal)
        return Scenario(
            x, adversary, adversary=adversary, path_kl=torch.zeros_like(state.path_kl)
        )

    def recent_tracks(self, now: Replan, futures: Tensor) -> Tensor:
        """Motions [tracks, B, HORIZON, 4] of the ego: its policy driven against nominal
        futures [S, B, V, HORIZON, 4], or samples of the prior where its plan is not
        known."""
        if self.knowledge == "plan":
            if now.react is None:
                return now.ego_plan[None, :, : futures.shape[-2]]
            return torch.stack([now.react(one) for one in futures[: self.tracks]])
        state = now.state
        world = now.world
        free = self.prior.encode(state.routed, state.lane, world)
        many = tiled(free, self.tracks)
        x0 = self.prior.sample(many, folded(now.noise[..., : self.tracks, :])).x0
        return motion_of(
            self.prior, x0, context=many, count=self.tracks, steps=slice(None)
        ).states()[:, :, 0]


def overlap_value(futures: Tensor, tracks: Tensor, size: Tensor) -> Tensor:
    """Returns DECAY^step of the first contact of futures [S, B, V, H, 4] with each of
    the ego's tracks [W, B, H, 4] (0 without one), mean over the tracks: [S, B, V]. size
    [B, V, 2]."""
    own = futures[..., STRIDE - 1 :: STRIDE, :]
    ego = tracks[..., STRIDE - 1 :: STRIDE, :]
    boxes = own[:, None], size[:, :, None], ego[None, :, :, None], size[:, :1, None]
    worth = DECAY ** (STRIDE * torch.arange(1, own.shape[-2] + 1, device=own.device))
    return (overlap(*boxes) * worth).amax(-1).mean(1)
