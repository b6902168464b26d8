#!/usr/bin/env bash
# TorchRL's FrameSkipTransform drives on after the end of an episode, and repeats one frame where the state is in the tensordict.
#
# The transform applies the same action to the environment for a number of frames, and adds the rewards up. It keeps the
# `done` of the last frame alone. A crash in one of the frames before it ends nothing: the car is stepped on beyond the
# crash, the episode goes on, and GAE bootstraps a value through it. The option frame_skip of GymWrapper, of the same
# package, stops at the frame that ends the episode. Of an environment that reads its state from the tensordict
# (stateless, as in TorchRL's pendulum tutorial) each of the four frames starts at the same state: the car moves one frame,
# and the reward is four times that of this frame. Neither is told. It matters to whoever lets a policy decide at 2 Hz in
# a simulator of 10 Hz. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 gymnasium==1.4.0 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import gymnasium
import numpy
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, FrameSkipTransform, GymWrapper, TransformedEnv

SKIP = 4  # frames per action
CRASH = 6.0  # m


class Car(gymnasium.Env):
    """A car that drives 1 m in each frame for a reward of 1, and crashes once, which costs 10 and ends the episode."""

    observation_space = gymnasium.spaces.Box(-100.0, 100.0, (1,), numpy.float32)
    action_space = gymnasium.spaces.Box(0.0, 1.0, (1,), numpy.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.x = 0.0
        return numpy.array([self.x], numpy.float32), {}

    def step(self, action):
        self.x += 1.0
        crash = self.x == CRASH
        return numpy.array([self.x], numpy.float32), -10.0 if crash else 1.0, crash, False, {}


class StatelessCar(EnvBase):
    """The same car on a free road, with its place in the tensordict."""

    batch_locked = False

    def __init__(self):
        super().__init__()
        self.observation_spec = Composite(observation=Unbounded((1,)))
        self.action_spec = Bounded(0.0, 1.0, (1,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(done=Binary(1, dtype=torch.bool), terminated=Binary(1, dtype=torch.bool))

    def _reset(self, tensordict):
        return TensorDict(observation=torch.zeros(1))

    def _step(self, tensordict):
        end = torch.zeros(1, dtype=torch.bool)
        x = tensordict["observation"] + 1.0
        return TensorDict(observation=x, reward=torch.ones(1), done=end, terminated=end.clone())

    def _set_seed(self, seed):
        pass


def driven(env):
    """Place [m], reward and end of each step of an episode of at most three steps."""
    after = env.rollout(3)["next"]
    return [tuple(after[key][step].item() for key in ("observation", "reward", "done")) for step in range(len(after))]


print("torchrl", version("torchrl"), "tensordict", version("tensordict"), "gymnasium", gymnasium.__version__)
option = driven(GymWrapper(Car(), frame_skip=SKIP))
transform = driven(TransformedEnv(GymWrapper(Car()), FrameSkipTransform(SKIP)))
stateless = driven(TransformedEnv(StatelessCar(), FrameSkipTransform(SKIP)))
print(f"(x, reward, done) of steps of {SKIP} frames, with a crash at x = {CRASH}")
print("  GymWrapper(frame_skip=4):", option)
print("  FrameSkipTransform(4):   ", transform)
print("on a free road, with the state in the tensordict")
print("  FrameSkipTransform(4):   ", stateless)
right = option == [(4.0, 4.0, False), (6.0, -9.0, True)]
beyond = transform == [(4.0, 4.0, False), (8.0, -7.0, False), (12.0, 4.0, False)]
repeated = stateless == [(1.0, 4.0, False), (2.0, 4.0, False), (3.0, 4.0, False)]
sys.exit(0 if right and beyond and repeated else 1)
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
