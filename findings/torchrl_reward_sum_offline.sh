#!/usr/bin/env bash
# TorchRL's RewardSum adds up the rewards of different cars where it is applied to collected data, or adds up nothing.
#
# RewardSum is documented to track cumulative values along the time dimension for each episode. In an environment it
# does. Applied to a rollout, or as the transform of a replay buffer, it sums along the dimension before the one that is
# named "time": of a rollout of several cars [car, time] it sums over the cars, so that the last car has the rewards of
# all of them at that moment and the first has its own. Of one car [time] there is no dimension before, the sum goes
# along the last one, of size 1, and the "sum" is the reward itself. The end of an episode is not looked at in either
# case. The shapes are right and nothing is said. It matters to whoever computes returns of recorded driving, for a
# report or as a training signal. A reward without its last dimension, which the rollouts here do not have, is summed
# over time. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Composite, LazyTensorStorage, ReplayBuffer, Unbounded
from torchrl.envs import EnvBase, RewardSum, SerialEnv, TransformedEnv

STEPS, LENGTH = 5, 3  # steps of a rollout, and of an episode


class Car(EnvBase):
    """A car that gets the same reward at each step; its episodes have three steps."""

    def __init__(self, reward):
        super().__init__()
        self.reward, self.time = reward, 0
        self.observation_spec = Composite(observation=Unbounded((1,)))
        self.action_spec = Unbounded((1,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(done=Binary(1, dtype=torch.bool), terminated=Binary(1, dtype=torch.bool))

    def _reset(self, tensordict):
        self.time = 0
        return TensorDict(observation=torch.zeros(1))

    def _step(self, tensordict):
        self.time += 1
        end = torch.tensor([self.time == LENGTH])
        return TensorDict(
            observation=torch.zeros(1), reward=torch.tensor([self.reward]), done=end, terminated=end.clone()
        )

    def _set_seed(self, seed):
        pass


def numbers(data):
    return data["next", "episode_reward"].squeeze(-1).tolist()


def offline():
    return RewardSum(in_keys=[("next", "reward")], out_keys=[("next", "episode_reward")])


def stored(data):
    """The same by a replay buffer of one item per car."""
    buffer = ReplayBuffer(storage=LazyTensorStorage(10), transform=offline())
    buffer.extend(data)
    return numbers(buffer[:])


print("torchrl", version("torchrl"), "tensordict", version("tensordict"))
one = Car(1.0)
two = SerialEnv(2, [lambda: Car(1.0), lambda: Car(10.0)])
good = True
for name, env in (("one car", one), ("two cars", two)):
    data = env.rollout(STEPS, break_when_any_done=False)
    online = TransformedEnv(env, RewardSum(in_keys=["reward"])).rollout(STEPS, break_when_any_done=False)
    wanted, seen = numbers(online), numbers(offline()(data.clone()))
    print(f"{name}, dimensions {data.names}")
    print("  rewards:                 ", data["next", "reward"].squeeze(-1).tolist())
    print("  in the environment:      ", wanted)
    print("  applied to the rollout:  ", seen)
    if name == "one car":
        good &= wanted == [1.0, 2.0, 3.0, 1.0, 2.0] and seen == [1.0] * STEPS
    else:
        buffered = stored(data)
        print("  of a replay buffer:      ", buffered)
        good &= wanted == [[1.0, 2.0, 3.0, 1.0, 2.0], [10.0, 20.0, 30.0, 10.0, 20.0]]
        good &= seen == buffered == [[1.0] * STEPS, [11.0] * STEPS]
bare = TensorDict(next=TensorDict(reward=torch.ones(STEPS), batch_size=[STEPS]), batch_size=[STEPS], names=["time"])
summed = offline()(bare)["next", "episode_reward"].tolist()
print("a reward of dimensions [time] alone, of one episode:", summed)
good &= summed == [1.0, 2.0, 3.0, 4.0, 5.0]
two.close()
sys.exit(0 if good else 1)
PYTHON
"$folder/venv/bin/python" -W ignore "$folder/program.py" > "$folder/out" 2> "$folder/log" || {
    cat "$folder/out" "$folder/log"
    exit 1
}
grep -v INFO "$folder/out"
