"""The policy's update: PPO on collected episodes."""

from collections import defaultdict
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer, SamplerWithoutReplacement, TensorStorage
from torchrl.modules import PopArtValueNorm
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from e2rl.learning.pretraining.supervised import take_step
from e2rl.planners.network import ActorCritic, ActorNetwork
from e2rl.run.config import configured, setting
from e2rl.sim.prospects import TIMES, time_to_contact

VALUE_MEMORY = 0.95  # weight of the past in the returns' mean and variance, per update
PRICED_FRAMES = 512  # of a minibatch, on which the policy's |acceleration| is measured
PEAK_MEMORY = 0.75  # of the past in the running maximum of |advantage|, per update
CRITIC = 0.5  # weight of the critic's loss
MAX_GRAD_NORM = 0.5


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


class Learner:
    """Improves an ActorCritic in place. `updates` counts the calls so far.

    The critic predicts returns in units of their running mean and standard deviation
    (`returns`); advantages are estimated from the values in units of the reward.
    """

    def __init__(
        self,
        network: ActorCritic,
        settings: UpdateSettings,
        total: int | None = None,
    ) -> None:
        """total: updates of the whole run, over which the learning rate falls to
        final_lr of it; None: constant."""
        self.network = network
        self.settings = settings
        self.total = total
        self.updates = 0
        self.returns = PopArtValueNorm(
            shape=1,
            beta=VALUE_MEMORY,
            device=network.device,
        )
        self.peak = torch.zeros((), device=network.device)  # of |advantage|, running
        self.ppo = ClipPPOLoss(
            *network.heads(),
            clip_epsilon=settings.clip,
            entropy_coeff=settings.entropy,
            critic_coeff=CRITIC,
            normalize_advantage=False,
            functional=False,
        )
        self.optimiser = torch.optim.Adam(network.parameters(), settings.learning_rate)

    def update(self, data: TensorDictBase) -> dict[str, float]:
        """One PPO iteration on a Collector's batch [B, T]; returns means of the losses
        and diagnostics.

        Passes end early when the policy has moved by target_kl. The first
        `critic_warmup` calls fit the critic alone. The observation statistics are
        updated at the end, so they are equal in collection and update.
        """
        settings = self.settings
        normaliser = self.network.normaliser
        observations = data["observation"].to(self.network.device)
        normalised = bool(normaliser.count > 0)
        if not normalised:  # the last layer is still zero: no probability changes
            normaliser.observe(observations)
        warming = self.updates < settings.critic_warmup
        frames = self._with_advantages(
            data, 0.0 if warming else settings.advantage_filter
        )
        rate = self._learning_rate()
        self.optimiser.param_groups[0]["lr"] = rate
        minibatches = ReplayBuffer(
            storage=TensorStorage(frames, device="auto"),
            sampler=SamplerWithoutReplacement(),
            batch_size=settings.minibatch,
        )
        columns = defaultdict(list)
        stopped = False
        for _ in range(settings.epochs):
            divergence = []
            for minibatch in minibatches:  # every frame once
                if warming:
                    losses = self._fit_critic(minibatch)
                else:
                    losses = self._step(minibatch)
                divergence.append(losses["kl"])
                for name, value in losses.items():
                    columns[name].append(value)
            mean = torch.stack(divergence).mean().item()
            stopped = not warming and mean > settings.target_kl
            if stopped:
                break
        if normalised:
            normaliser.observe(observations)
        self.updates += 1
        deviation = self.network.network.std
        return {
            **{
                name: torch.stack(values).mean().item()
                for name, values in columns.items()
            },
            "stopped_by_kl": float(stopped),
            "std_acceleration": deviation[0].item(),
            "std_yaw_rate": deviation[1].item(),
            "steps": float(len(columns["kl"])),
            "learning_rate": rate,
            "frames_used": len(frames) / data.numel(),
        }

    def _learning_rate(self) -> float:
        """Of this update: it falls linearly to final_lr of it."""
        settings = self.settings
        part = 0.0 if self.total is None else min(self.updates / self.total, 1.0)
        return settings.learning_rate * (1 - (1 - settings.final_lr) * part)

    @torch.no_grad()
    def _with_advantages(self, data: TensorDictBase, least: float) -> TensorDict:
        """The frames [F] of a batch [B, T] with what the losses read; advantages are
        normalised over the whole batch.

        Frames are left out whose |advantage| is below `least` times its running
        maximum: there is little to learn from them.
        """
        keys = (*self.network.inputs, "action", "action_log_prob", "next")
        data = data.select(*keys).to(self.network.device)
        inputs = self.network.prepared(data)
        advantage, target = self.advantages(data, inputs["seen"])
        self.returns.update(target)
        size = advantage.abs()
        highest = size.max()
        if self.updates:
            highest = torch.lerp(highest, self.peak, PEAK_MEMORY)
        self.peak = highest
        frames = data.select("action", "action_log_prob").update(inputs)
        frames["calm"] = time_to_contact(data["observation"]) > TIMES[-1]
        deviation = advantage.std().clamp(min=1e-6)
        frames["advantage"] = (advantage - advantage.mean()) / deviation
        frames["value_target"] = self.returns.normalize(target)
        instructive = (size >= least * self.peak)[..., 0]
        if least == 0 or not bool(instructive.any()):
            return frames.reshape(-1)
        return frames[instructive]

    @torch.no_grad()
    def advantages(self, data: TensorDictBase, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Generalised advantage estimates and returns [B, T, 1] of a batch; seen [B, T,
        D]: normalised observations.

        The value of a next observation is that of the following frame, but at the
        batch's end and where an episode is cut off.
        """
        after = data["next"]
        value = self._value(seen)
        terminated = after["terminated"]
        cut = after["done"] & ~terminated
        cut[:, -1] = True
        following = torch.cat([value[:, 1:], value[:, -1:]], 1)
        last = self.network.normaliser(after["observation"][cut[..., 0]])
        following[cut] = self._value(last)[..., 0]
        return generalized_advantage_estimate(
            self.settings.gamma,
            self.settings.lmbda,
            state_value=value,
            next_state_value=following,
            reward=after["reward"],
            done=after["done"],
            terminated=terminated,
        )

    def _value(self, seen: Tensor) -> Tensor:
        """Values [..., 1] in units of the reward."""
        return self.returns.denormalize(self.network.critic.module[1](seen))

    def _fit_critic(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """One optimiser step of the critic alone; the losses and diagnostics."""
        losses = self._ppo_losses(minibatch)
        del losses["loss_entropy"]
        return self._descend(losses["loss_critic"], losses)

    def _step(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """One optimiser step; the losses and diagnostics."""
        settings = self.settings
        network = self.network.network
        losses = self._ppo_losses(minibatch)
        total = losses["loss_critic"] + losses["loss_objective"]
        total = total + losses.pop("loss_entropy")
        if settings.action_penalty > 0:
            penalty = action_penalty(network, minibatch[:PRICED_FRAMES])
            losses["action_penalty"] = penalty
            total = total + settings.action_penalty * penalty
        return self._descend(total, losses)

    def _ppo_losses(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """The losses of TorchRL's PPO and its diagnostics."""
        losses = self.ppo(minibatch)
        names = ("loss_objective", "loss_critic", "loss_entropy", "clip_fraction")
        return {
            **{name: losses[name] for name in (*names, "entropy")},
            "kl": losses["kl_approx"],
            "explained_variance": losses["explained_variance"].mean(),
        }

    def _descend(self, total: Tensor, losses: dict[str, Tensor]) -> dict[str, Tensor]:
        """A step down the gradient of `total`; the losses, detached."""
        take_step(self.optimiser, total, max_grad_norm=MAX_GRAD_NORM)
        return {name: value.detach().mean() for name, value in losses.items()}

    def state_dict(self) -> dict:
        """Optimiser, counter and running statistics; the weights are the network's."""
        return {
            "optimiser": self.optimiser.state_dict(),
            "returns": self.returns.state_dict(),
            "peak": self.peak,
            "updates": self.updates,
        }

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
    calm = frames["calm"]
    return (acceleration.abs() * calm).sum() / calm.sum().clamp(min=1) / 4
