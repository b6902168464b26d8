"""TorchRL's SAC in attacked traffic: `python examples/torchrl_sac.py [STEPS]
[POLICY.pt]`.

Half of the episodes are nominal, half attacked by e2 at an intensity of 1; an action
lasts 0.2 s. POLICY.monitor.csv gets return, length and end of every episode.
"""

import sys
from pathlib import Path
from typing import TextIO

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

import e2rl
from e2rl.sim.observation import OBSERVATION_SIZE

HOLD = 2  # steps of 0.1 s that an action lasts
BATCH, UPDATES = (
    256,
    8,
)  # transitions of an update; updates after a step of all environments


class Policy(nn.Module):
    """Mean and spread of the action before squashing, narrow at first; as a module, the
    most central action."""

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        layers = MLP(
            OBSERVATION_SIZE, 4, num_cells=[128, 128], activation_class=nn.SiLU
        )
        self.layers = nn.Sequential(
            layers, NormalParamExtractor(scale_mapping="biased_softplus_0.2")
        )
        self.bounds = low, high

    def forward(self, observation: Tensor) -> Tensor:
        low, high = self.bounds
        return (low + high) / 2 + (high - low) / 2 * self.layers(observation)[0].tanh()


def note(monitor: TextIO, batch: TensorDictBase) -> None:
    """Write a row for each episode that ended."""
    last = batch["next"][batch["next", "done"][..., 0]]
    metrics = [last["metrics", name] for name in ("contact", "off_road", "progress")]
    for row in torch.cat(
        [last["episode_reward"], last["timestep"] / HOLD, *metrics], 1
    ).tolist():
        print(*(f"{value:g}" for value in row), sep=",", file=monitor)


def main(
    steps: str = "100000", file: str = "sac.pt", num_envs: int = 64, **settings
) -> None:
    """Train a new policy and write it; settings: of e2rl.make_env."""
    torch.manual_seed(0)
    env = TransformedEnv(
        e2rl.make_env(num_envs, hold=HOLD, seed=0, **settings), RewardSum()
    )
    spec = env.action_spec_unbatched
    policy = Policy(spec.space.low, spec.space.high)
    seen = TensorDictModule(policy.layers, ["observation"], ["loc", "scale"])
    bounds = {"low": spec.space.low, "high": spec.space.high}
    actor = ProbabilisticActor(
        seen,
        ["loc", "scale"],
        ["action"],
        spec=spec,
        distribution_class=TanhNormal,
        distribution_kwargs=bounds,
    )
    values = MLP(
        OBSERVATION_SIZE + 2, 1, num_cells=[128, 128], activation_class=nn.SiLU
    )
    values = ValueOperator(values, in_keys=["observation", "action"])
    loss = SACLoss(actor, values, action_spec=spec, alpha_init=0.1)
    loss.make_value_estimator(gamma=0.97)
    target = SoftUpdate(loss, tau=0.005)
    optimiser = torch.optim.Adam(loss.parameters(), 3e-4)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(int(steps)), batch_size=BATCH
    )
    options = {
        "frames_per_batch": num_envs,
        "total_frames": int(steps),
        "auto_register_policy_transforms": False,
    }
    with Path(file).with_suffix(".monitor.csv").open("w") as monitor:
        print("r,l,contact,off_road,progress", file=monitor)
        for batch in Collector(env, actor, **options):
            buffer.extend(batch.reshape(-1).select("observation", "action", "next"))
            for _ in range(UPDATES):
                found = loss(buffer.sample())
                optimiser.zero_grad()
                (
                    found["loss_actor"] + found["loss_qvalue"] + found["loss_alpha"]
                ).backward()
                optimiser.step()
                target.step()
            note(monitor, batch)
    e2rl.save_policy(policy, file)
    print(f"measure it by: python evaluate.py ego=policy_file ego.file={file}")


if __name__ == "__main__":
    main(*sys.argv[1:])
