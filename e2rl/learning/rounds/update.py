"""The policy's update: PPO on collected episodes, behaviour cloning and a teacher's
labels, by one optimiser."""

from collections import defaultdict
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer, SamplerWithoutReplacement, TensorStorage
from torchrl.modules import PopArtValueNorm
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from e2rl.learning.pretraining.cloning import (
    NOISE,
    cloning_loss,
    mirrored_labels,
    sampled,
    teaching_loss,
)
from e2rl.learning.pretraining.supervised import take_step
from e2rl.planners.network import ActorCritic, ActorNetwork
from e2rl.run.settings import configured, setting
from e2rl.sim.prospects import TIMES, time_to_contact

VALUE_MEMORY = 0.95  # weight of the past in the running mean and variance of the returns, per update
PRICED_FRAMES = 512  # of a minibatch, on which the policy's |acceleration| is measured
PEAK_MEMORY = 0.75  # of the past in the running maximum of |advantage|, per update
CRITIC = 0.5  # weight of the critic's loss
MAX_GRAD_NORM = 0.5
CLONED = 256  # demonstrations, and labels of a teacher, of an optimiser step


@configured("learner/ppo_bc", "ppo")
@dataclass(frozen=True)
class UpdateSettings:
    """Settings `learner.ppo`."""

    learning_rate: float = setting(low=0)
    final_lr: float = setting(low=0)
    gamma: float = setting(low=0, high=1)
    lmbda: float = setting(low=0, high=1)
    clip: float = setting(low=0)
    entropy: float = setting()
    epochs: int = setting(low=1)
    minibatch: int = setting(low=1)
    target_kl: float = setting(low=0)
    advantage_filter: float = setting(low=0, high=1)
    critic_warmup: int = setting(low=0)
    action_penalty: float = setting(low=0)
    teaching: float = setting(low=0)
    cloning: float = setting(low=0)


class Learner:
    """Improves an ActorCritic in place. `updates` counts the calls so far.

    The critic predicts returns in units of their running mean and standard deviation
    (`returns`); advantages are estimated from the values in units of the reward.
    """

    def __init__(
        self, network: ActorCritic, settings: UpdateSettings, total: int | None = None
    ) -> None:
        """total: updates of the whole run, over which the learning rate falls to
        final_lr of it; None: constant."""
        self.network = network
        self.settings = settings
        self.total = total
        self.updates = 0
        self.returns = PopArtValueNorm(
            shape=1, beta=VALUE_MEMORY, device=network.device
        )
        self.peak = torch.zeros(
            (), device=network.device
        )  # running maximum of |advantage|
        self.ppo = ClipPPOLoss(
            *network.heads(),
            clip_epsilon=settings.clip,
            entropy_coeff=settings.entropy,
            critic_coeff=CRITIC,
            normalize_advantage=False,
            functional=False,
        )
        self.optimiser = torch.optim.Adam(network.parameters(), settings.learning_rate)

    def update(
        self,
        data: TensorDictBase,
        demonstrations: TensorDictBase | None = None,
        labels: TensorDictBase | None = None,
    ) -> dict[str, float]:
        """One PPO iteration on a Collector's batch [B, T]; returns means of the losses
        and diagnostics.

        Passes end early when the policy has moved by target_kl. The first
        `critic_warmup` calls fit the critic alone. The observation statistics are
        updated at the end, so they are equal in collection and update.

        Args:
            demonstrations: [M] (e2rl.learning.pretraining.cloning) that are cloned.
            labels: a teacher's labels [M].
        """
        settings = self.settings
        sums = defaultdict(list)
        stopped = False
        seen_before = bool(self.network.normaliser.count > 0)
        if (
            not seen_before
        ):  # the last layer is still zero, so statistics change no probability
            self.network.normaliser.observe(data["observation"].to(self.network.device))
        warming = self.updates < settings.critic_warmup
        flat = self._with_advantages(
            data, 0.0 if warming else settings.advantage_filter
        )
        done = 0.0 if self.total is None else min(self.updates / self.total, 1.0)
        self.optimiser.param_groups[0]["lr"] = rate = settings.learning_rate * (
            1 - (1 - settings.final_lr) * done
        )
        storage = TensorStorage(flat, device="auto")
        sampler = SamplerWithoutReplacement()
        minibatches = ReplayBuffer(
            storage=storage, sampler=sampler, batch_size=settings.minibatch
        )
        for _ in range(settings.epochs):
            moved = []
            for minibatch in minibatches:  # every frame once
                losses = self._step(
                    minibatch, demonstrations, labels=labels, warming=warming
                )
                moved.append(losses["kl"])
                for name, value in losses.items():
                    sums[name].append(value)
            stopped = (
                not warming and torch.stack(moved).mean().item() > settings.target_kl
            )
            if stopped:
                break
        if seen_before:
            self.network.normaliser.observe(data["observation"].to(self.network.device))
        self.updates += 1
        result = {
            name: torch.stack(values).mean().item() for name, values in sums.items()
        }
        return result | {
            "stopped_by_kl": float(stopped),
            "std_acceleration": self.network.network.std[0].item(),
            "std_yaw_rate": self.network.network.std[1].item(),
            "steps": float(len(sums["kl"])),
            "learning_rate": rate,
            "frames_used": len(flat) / data.numel(),
        }

    @torch.no_grad()
    def _with_advantages(self, data: TensorDictBase, least: float) -> TensorDict:
        """The frames [F] of a batch [B, T] with what the losses read; advantages are
        normalised over the whole batch.

        Frames are left out whose |advantage| is below `least` times its running
        maximum: there is little to learn from them.
        """
        data = data.select("observation", "action", "action_log_prob", "next").to(
            self.network.device
        )
        inputs = self.network.prepared(data["observation"])
        advantage, target = self.advantages(data, inputs["seen"])
        self.returns.update(target)
        size = advantage.abs()
        highest = advantage.abs().max()
        self.peak = (
            highest
            if self.updates == 0
            else torch.lerp(highest, self.peak, PEAK_MEMORY)
        )
        frames = data.select("action", "action_log_prob").update(inputs)
        frames["calm"] = time_to_contact(data["observation"]) > TIMES[-1]
        frames["advantage"] = (advantage - advantage.mean()) / advantage.std().clamp(
            min=1e-6
        )
        frames["value_target"] = self.returns.normalize(target)
        kept = (size >= least * self.peak)[..., 0]
        return (
            frames.reshape(-1) if least == 0 or not bool(kept.any()) else frames[kept]
        )

    @torch.no_grad()
    def advantages(self, data: TensorDictBase, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Generalised advantage estimates and returns [B, T, 1] of a batch; seen [B, T,
        D]: normalised observations.

        The value of a next observation is that of the following frame, but at the
        batch's end and where an episode is cut off.
        """
        after = data["next"]
        settings = self.settings
        value = self._value(seen)
        done = after["done"]
        terminated = after["terminated"]
        cut = done & ~terminated
        cut[:, -1] = True
        following = torch.cat([value[:, 1:], value[:, -1:]], 1)
        following[cut] = self._value(
            self.network.normaliser(after["observation"][cut[..., 0]])
        )[..., 0]
        rewards = after["reward"], done, terminated
        return generalized_advantage_estimate(
            settings.gamma, settings.lmbda, value, following, *rewards
        )

    def _value(self, seen: Tensor) -> Tensor:
        """Values [..., 1] in units of the reward."""
        return self.returns.denormalize(self.network.critic.module[1](seen))

    def _step(
        self,
        minibatch: TensorDictBase,
        demonstrations: TensorDictBase | None,
        labels: TensorDictBase | None,
        warming: bool,
    ) -> dict[str, Tensor]:
        """One optimiser step; the losses and diagnostics, detached."""
        settings = self.settings
        out = self.ppo(minibatch)
        total = out["loss_critic"]
        if not warming:
            total = total + out["loss_objective"] + out["loss_entropy"]
        losses = {
            "loss_objective": out["loss_objective"],
            "loss_critic": out["loss_critic"],
            "kl": out["kl_approx"],
            "clip_fraction": out["clip_fraction"],
            "entropy": out["entropy"],
            "explained_variance": out["explained_variance"].mean(),
        }
        if settings.action_penalty > 0 and not warming:
            losses["action_penalty"] = action_penalty(
                self.network.network, minibatch[:PRICED_FRAMES]
            )
            total = total + settings.action_penalty * losses["action_penalty"]
        if demonstrations is not None and settings.cloning > 0 and not warming:
            shown = sampled(demonstrations, CLONED).to(self.network.device)
            with self.network.network.noisy(*NOISE):
                losses["loss_cloning"] = cloning_loss(self.network.actor, shown)
            total = total + settings.cloning * losses["loss_cloning"]
        if labels is not None and settings.teaching > 0 and not warming:
            drawn = sampled(labels, CLONED).to(self.network.device)
            both = torch.cat([mirrored_labels(drawn[::2]), drawn[1::2]])
            losses["loss_teaching"] = teaching_loss(self.network.network, both)
            total = total + settings.teaching * losses["loss_teaching"]
        take_step(self.optimiser, total, max_grad_norm=MAX_GRAD_NORM)
        return {name: value.detach().mean() for name, value in losses.items()}

    def state_dict(self) -> dict:
        """Optimiser, counter and running statistics; the weights are the network's."""
        statistics = {"returns": self.returns.state_dict(), "peak": self.peak}
        return {
            "optimiser": self.optimiser.state_dict(),
            "updates": self.updates,
        } | statistics

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.returns.load_state_dict(state["returns"])
        self.peak = state["peak"].to(self.network.device)
        self.updates = state["updates"]


def action_penalty(network: ActorNetwork, frames: TensorDictBase) -> Tensor:
    """Mean |acceleration| [] of the actor's most central actions, in units of 4 m/s^2.

    The mean is over those of frames [M] (`seen`, `offset`) that are `calm` [M], with no
    contact in sight: whoever is about to be hit may brake or accelerate as hard as it
    helps. A price on what the policy means to do, not on what exploration makes of it:
    under a standard deviation above 1 m/s^2 the price of the action itself
    (`sim.reward.acceleration`) hardly tells small accelerations from none.
    """
    loc, _ = network.head(frames["seen"], frames["offset"])
    acceleration = network.middle[0] + network.reach[0] * loc[..., 0].tanh()
    return (
        (acceleration.abs() * frames["calm"]).sum()
        / frames["calm"].sum().clamp(min=1)
        / 4
    )
