"""The policy's update: PPO on collected episodes and behaviour cloning on expert pairs, one optimiser for both."""

from collections import defaultdict
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import BCLoss, ClipPPOLoss
from torchrl.objectives.value import GAE

from e2rl.ego.network import ActorCritic
from e2rl.errors import InputError

EXPERT_SHARE = 0.99  # expert actions are clipped to this share of the bounds, where the squashed density is infinite
PPO_KEYS = ("observation", "action", "action_log_prob", "advantage", "value_target", "state_value")


@dataclass(frozen=True)
class UpdateSettings:
    """Fields: conf/learner/ppo_bc.yaml."""

    learning_rate: float = 3e-4
    gamma: float = 0.98
    lmbda: float = 0.95
    clip: float = 0.2
    entropy: float = 1e-3
    critic: float = 0.5
    epochs: int = 4
    minibatch: int = 1024
    max_grad_norm: float = 0.5
    target_kl: float = 0.02
    critic_warmup: int = 1
    cloning: float = 0.1
    cloning_minibatch: int = 256
    feature_noise: float = 0.3
    last_action_noise: float = 1.0


class Learner:
    """Improves an ActorCritic in place. `updates` counts the calls so far."""

    def __init__(self, network: ActorCritic, settings: UpdateSettings) -> None:
        self.network, self.settings, self.updates = network, settings, 0
        self.gae = GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=network.critic, deactivate_vmap=True)
        self.ppo = ClipPPOLoss(
            network.actor,
            network.critic,
            clip_epsilon=settings.clip,
            entropy_coeff=settings.entropy,
            critic_coeff=settings.critic,
            normalize_advantage=False,
        )
        self.cloning = BCLoss(network.actor)
        self.optimiser = torch.optim.Adam(network.parameters(), settings.learning_rate)

    def update(self, data: TensorDictBase, expert: TensorDictBase | None = None) -> dict[str, float]:
        """One PPO iteration on a Collector's batch [B, T], with behaviour cloning on expert pairs [M].

        Passes end early when the policy has moved by target_kl. The first `critic_warmup` calls fit the critic alone.
        The observation statistics are updated at the end, so they are equal in collection and update.
        Returns means of the losses and diagnostics.
        """
        settings, sums, stopped = self.settings, defaultdict(list), False
        seen_before = bool(self.network.normaliser.count > 0)
        if not seen_before:  # the last layer is still zero, so statistics change no probability
            self.network.normaliser.observe(data["observation"].to(self.network.device))
        flat = self._with_advantages(data)
        warming = self.updates < settings.critic_warmup
        for _ in range(settings.epochs):
            moved = []
            for index in torch.randperm(len(flat), device=flat.device).split(settings.minibatch):
                losses = self._step(flat[index], expert, warming)
                moved.append(losses["kl"])
                for name, value in losses.items():
                    sums[name].append(value)
            stopped = not warming and torch.stack(moved).mean().item() > settings.target_kl
            if stopped:
                break
        if seen_before:
            self.network.normaliser.observe(flat["observation"])
        self.updates += 1
        result = {name: torch.stack(values).mean().item() for name, values in sums.items()}
        return result | {
            "stopped_by_kl": float(stopped),
            "std_acceleration": self._std()[0],
            "std_yaw_rate": self._std()[1],
            "steps": float(len(sums["kl"])),
        }

    def _with_advantages(self, data: TensorDictBase) -> TensorDict:
        """Frames [B T] with PPO_KEYS; advantages are normalised over the whole batch."""
        with torch.no_grad():
            data = self.gae(data.to(self.network.device))
        flat = data.select(*PPO_KEYS).reshape(-1)
        advantage = flat["advantage"]
        flat["advantage"] = (advantage - advantage.mean()) / advantage.std().clamp(min=1e-6)
        return flat

    def _step(self, minibatch: TensorDictBase, expert: TensorDictBase | None, warming: bool) -> dict[str, Tensor]:
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
        if expert is not None and len(expert) and settings.cloning > 0 and not warming:
            pick = torch.randint(len(expert), (settings.cloning_minibatch,), device=expert.device)
            with self.network.network.noisy(settings.feature_noise, settings.last_action_noise):
                losses["loss_cloning"] = self.cloning(expert[pick].to(self.network.device))["loss_bc"]
            total = total + settings.cloning * losses["loss_cloning"]
        take_step(self.optimiser, total, settings.max_grad_norm)
        return {name: value.detach().mean() for name, value in losses.items()}

    @torch.no_grad()
    def _std(self) -> list[float]:
        return self.network.network.std.tolist()

    def state_dict(self) -> dict:
        """Optimiser and counter; the weights are the network's."""
        return {"optimiser": self.optimiser.state_dict(), "updates": self.updates}

    def load_state_dict(self, state: dict) -> None:
        """Restore a `state_dict`."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.updates = state["updates"]


def take_step(optimiser: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float) -> None:
    """One step down the gradient of `loss`, its norm clipped; raises InputError if the loss is not finite."""
    if not torch.isfinite(loss):
        raise InputError("learner: the loss is not finite; lower learner.*.learning_rate or check the observations")
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    parameters = [value for group in optimiser.param_groups for value in group["params"]]
    torch.nn.utils.clip_grad_norm_(parameters, max_grad_norm)
    optimiser.step()


def clip_expert(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Actions [..., 2] within EXPERT_SHARE of the bounds low, high [2]."""
    middle, reach = (high + low) / 2, (high - low) / 2 * EXPERT_SHARE
    return torch.maximum(torch.minimum(action, middle + reach), middle - reach)
