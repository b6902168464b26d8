"""Learners of TorchRL on attacked traffic: `python examples/torchrl_learners.py ppo|sac [FRAMES] [FILE]`.

ppo: TorchRL's PPOTrainer; sac: a loop round its SACLoss. Both train e2rl's actor for FRAMES decisions of 0.2 s, by
default 640, which shows that it runs and teaches nothing, and write it to FILE, by default actor.safetensors.
"""

import sys
from pathlib import Path

import torch
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import Compose, RewardSum, TransformedEnv
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss, SACLoss, SoftUpdate
from torchrl.trainers.algorithms import PPOTrainer

import e2rl
from e2rl.learning.policy import RowDraw
from e2rl.planners.network import ActorCritic
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.sim.observation import OBSERVATION_SIZE
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.rollout import synthesize_traffic
from e2rl.traffic.transform import AdversarialSynthesizer

SCENES, BATCH, STEPS = 4, 16, 10  # scenes; environments, and decisions of each in a collected batch
MINIBATCH, GAMMA = 64, 0.97


def attacked(seed: int = 0) -> TransformedEnv:
    """BATCH environments in bundled scenes, half of them attacked by e2 at an intensity of 1, half as recorded."""
    scenes, sim, every = e2rl.load_scenes("bundled", SCENES), SimSettings(), torch.arange(SCENES)
    attack = synthesize_traffic(scenes, e2rl.make_traffic("e2", e2rl.load_prior()), sim)
    pool = TrafficPool.stored(attack(e2rl.make_ego("actor"), every, 1.0, seed), 1.0) + TrafficPool.recorded(every)
    draw = RowDraw(torch.ones(len(pool), dtype=torch.float64))
    base = DrivingEnv(scenes, sim, BATCH, hold=2)
    env = TransformedEnv(base, Compose(AdversarialSynthesizer(pool, draw), RewardSum()))
    env.set_seed(seed)  # of the draws
    return env


def collected(env: TransformedEnv, network: ActorCritic, frames: int) -> Collector:
    """Batches [BATCH, STEPS] by the network's actor, whose observations are normalised by those of a first one."""
    network.normaliser.observe(env.rollout(STEPS, network.actor, break_when_any_done=False)["observation"])
    size = BATCH * STEPS
    options = {"frames_per_batch": size, "total_frames": frames, "auto_register_policy_transforms": False}
    return Collector(env, network.actor, **options)


def ppo(env: TransformedEnv, network: ActorCritic, frames: int) -> None:
    """Train the network by TorchRL's PPOTrainer, four passes over every batch."""
    loss = ClipPPOLoss(network.actor, network.critic, entropy_coeff=0.0)
    storage, sampler = LazyTensorStorage(BATCH * STEPS), SamplerWithoutReplacement()
    trainer = PPOTrainer(
        collector=collected(env, network, frames),
        total_frames=frames,
        frame_skip=1,
        optim_steps_per_batch=-(-BATCH * STEPS // MINIBATCH),
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), 3e-4),
        replay_buffer=TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=MINIBATCH),
        gamma=GAMMA,
        clip_norm=0.5,
        progress_bar=False,
    )
    trainer.train()


class ActionValue(nn.Module):
    """Values [..., 1] of actions [..., 2] (m/s^2, rad/s) at observations [..., D]."""

    def __init__(self, network: ActorCritic) -> None:
        super().__init__()
        self.normaliser, self.high = network.normaliser, network.high
        self.layers = nn.Sequential(nn.Linear(OBSERVATION_SIZE + 2, 128), nn.SiLU(), nn.Linear(128, 1))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.layers(torch.cat([self.normaliser(observation), action / self.high], -1))


def sac(env: TransformedEnv, network: ActorCritic, frames: int) -> None:
    """Train the network's actor by TorchRL's SACLoss, a step for each MINIBATCH of frames."""
    values = ValueOperator(ActionValue(network), in_keys=["observation", "action"])
    spec = env.action_spec_unbatched
    loss = SACLoss(network.actor, values, num_qvalue_nets=2, action_spec=spec, alpha_init=0.01)
    loss.make_value_estimator(gamma=GAMMA)
    target, optimiser = SoftUpdate(loss, tau=0.005), torch.optim.Adam(loss.parameters(), 3e-4)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(max(frames, BATCH * STEPS)), batch_size=MINIBATCH)
    for batch in collected(env, network, frames):
        buffer.extend(batch.reshape(-1))
        for _ in range(BATCH * STEPS // MINIBATCH):
            found = loss(buffer.sample())
            total = found["loss_actor"] + found["loss_qvalue"] + found["loss_alpha"]
            optimiser.zero_grad()
            total.backward()
            optimiser.step()
            target.step()
        print({name: round(found[name].item(), 3) for name in ("loss_actor", "loss_qvalue", "alpha")})


def main(learner: str, frames: str = "640", file: str = "actor.safetensors") -> None:
    """Train a new actor and write it."""
    torch.manual_seed(0)
    network = e2rl.make_ego("actor").network
    {"ppo": ppo, "sac": sac}[learner](attacked(), network, int(frames))
    network.save(Path(file))
    print(f"measure it by: python evaluate.py ego=actor ego.checkpoint={file}")


if __name__ == "__main__":
    main(*sys.argv[1:])
