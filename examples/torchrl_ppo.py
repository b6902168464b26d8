"""TorchRL's PPOTrainer on e2rl's actor: `python examples/torchrl_ppo.py [FRAMES]
[FILE]`.

Half of the episodes are nominal, half attacked by e2 at an intensity of 1. FRAMES
decisions of 0.2 s, by default 640, show that it runs and teach nothing; FILE is by
default actor.safetensors.
"""

import sys
from pathlib import Path

import torch
from torchrl.collectors import Collector
from torchrl.data import (
    LazyTensorStorage,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.objectives import ClipPPOLoss
from torchrl.trainers.algorithms import PPOTrainer

import e2rl
from e2rl.planners.network import ActorCritic

BATCH, STEPS = 16, 10  # environments, and decisions of each in a collected batch
MINIBATCH = 64
GAMMA = 0.97


def collected(env: TransformedEnv, network: ActorCritic, frames: int) -> Collector:
    """Batches [BATCH, STEPS] by the network's actor, whose observations are normalised
    by those of a first one."""
    network.normaliser.observe(
        env.rollout(STEPS, network.actor, break_when_any_done=False)["observation"]
    )
    size = BATCH * STEPS
    options = {
        "frames_per_batch": size,
        "total_frames": frames,
        "auto_register_policy_transforms": False,
    }
    return Collector(env, network.actor, **options)


def ppo(env: TransformedEnv, network: ActorCritic, frames: int) -> None:
    """Train the network by TorchRL's PPOTrainer, four passes over every batch."""
    loss = ClipPPOLoss(network.actor, network.critic, entropy_coeff=0.0)
    storage = LazyTensorStorage(BATCH * STEPS)
    sampler = SamplerWithoutReplacement()
    trainer = PPOTrainer(
        collector=collected(env, network, frames),
        total_frames=frames,
        frame_skip=1,
        optim_steps_per_batch=-(-BATCH * STEPS // MINIBATCH),
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), 3e-4),
        replay_buffer=TensorDictReplayBuffer(
            storage=storage, sampler=sampler, batch_size=MINIBATCH
        ),
        gamma=GAMMA,
        clip_norm=0.5,
        progress_bar=False,
    )
    trainer.train()


def main(frames: str = "640", file: str = "actor.safetensors", **settings) -> None:
    """Train a new actor and write it; settings: of e2rl.make_env."""
    torch.manual_seed(0)
    network = e2rl.make_ego("actor").network
    ppo(
        TransformedEnv(e2rl.make_env(BATCH, hold=2, seed=0, **settings), RewardSum()),
        network,
        int(frames),
    )
    network.save(Path(file))
    print(f"measure it by: python evaluate.py ego=actor ego.checkpoint={file}")


if __name__ == "__main__":
    main(*sys.argv[1:])
