"""CAT (Zhang et al. 2023): of likely futures, the one that overlaps most with the ego's
recent tracks."""

from dataclasses import dataclass

import torch
from torch import Tensor

from e2rl.prior.prior import Context
from e2rl.run.config import check_range, configured, setting
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
    open loop, others replay. Nothing is optimised, so there is no step size; the gain
    is the number of candidates per unit of eta."""

    samples: int = setting(low=1)
    spread: float = setting(low=0)
    tracks: int = setting(low=1)

    tuned = {"gain": (0.5, 16.0, "log")}

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(
            "synthesizer.tracks",
            self.tracks,
            low=1,
            high=self.samples,
        )
        self.queries_ego = self.knowledge == "plan"

    def replan(
        self,
        state: OpenLoopState,
        world: World,
        ego_plan: Tensor,
        react: React | None = None,
    ) -> tuple[OpenLoopState, TrafficPlan]:
        """Returns states and plans (`Traffic.replan`); with strength all replay that
        have never been adversaries: who has left its recording does not return to it."""
        state, plan = super().replan(state, world, ego_plan, react)
        driven = state.held | state.released | (self.strength(state) <= 0)[:, None]
        return replay_others(
            state,
            plan,
            world=world,
            driven=driven,
        )

    def scenario(
        self,
        replan: Replan,
        context: Context,
        nominal: Tensor,
    ) -> Scenario:
        """The nominal sample with the future of greatest overlap in its vehicle's row,
        which alone is held."""
        state = replan.state
        vehicles = context.active.shape[1]
        # The first sample is the nominal one.
        first, others = replan.noise.split([1, self.samples - 1], 3)
        x0, futures = self.futures(torch.cat([first, self.spread * others], 3), context)
        size = replan.world.scene["size"][:, :vehicles]
        value = overlap_value(
            futures,
            self.recent_tracks(replan, futures),
            size=size,
        )
        number = torch.arange(self.samples, device=value.device)[:, None]
        tried = number < self.strength(state).round().clamp(min=1)
        value = value * context.active * tried[..., None]
        best, place = value.transpose(0, 1).flatten(1).max(-1)
        vehicle = torch.arange(vehicles, device=place.device)
        adversary = vehicle == (place % vehicles)[:, None]
        adversary = adversary & (best > 0)[:, None]
        chosen = pick(x0, place // vehicles)
        return Scenario(
            torch.where(adversary[..., None], chosen, nominal),
            adversary,
            adversary=adversary,
            path_kl=torch.zeros_like(state.path_kl),
        )

    def futures(self, noise: Tensor, context: Context) -> tuple[Tensor, Tensor]:
        """Joint samples [S * B, V, SIZE] of the prior by noise [K, B, V, S, SIZE], and
        their states [S, B, V, HORIZON, 4]."""
        samples = tiled(context, noise.shape[3])
        x0 = self.prior.sample(samples, folded(noise)).x0
        motion = motion_of(
            self.prior,
            x0,
            context=samples,
            batch=len(context.active),
            steps=slice(None),
        )
        return x0, motion.states()

    def recent_tracks(self, replan: Replan, futures: Tensor) -> Tensor:
        """Motions [tracks, B, HORIZON, 4] of the ego: its policy driven against nominal
        futures [S, B, V, HORIZON, 4], or samples of the prior where its plan is not
        known."""
        if self.knowledge != "plan":
            state = replan.state
            free = self.prior.encode(state.routed, state.lane, replan.world)
            noise = replan.noise[..., : self.tracks, :]
            return self.futures(noise, free)[1][:, :, 0]
        if replan.react is None:
            return replan.ego_plan[None, :, : futures.shape[-2]]
        nominal = futures[: self.tracks]
        return torch.stack([replan.react(states) for states in nominal])


def overlap_value(
    futures: Tensor,
    tracks: Tensor,
    size: Tensor,
) -> Tensor:
    """Returns DECAY^step of the first contact of futures [S, B, V, H, 4] with each of
    the ego's tracks [W, B, H, 4] (0 without one), mean over the tracks: [S, B, V]. size
    [B, V, 2]."""
    states = futures[..., STRIDE - 1 :: STRIDE, :]
    ego = tracks[..., STRIDE - 1 :: STRIDE, :]
    touches = overlap(
        states[:, None],
        size[:, :, None],
        second=ego[None, :, :, None],
        second_size=size[:, :1, None],
    )
    moment = torch.arange(1, states.shape[-2] + 1, device=states.device)
    return (touches * DECAY ** (STRIDE * moment)).amax(-1).mean(1)
