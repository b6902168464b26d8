#!/usr/bin/env bash
# TorchRL's n-step returns look beyond a crash: two of three steps before the end of an episode are not marked as its end.
#
# MultiStepTransform (in a replay buffer) and MultiStep (behind a collector) replace each next observation by the one that is
# n steps later, or by the last of the episode if that is nearer, and the reward by the discounted sum on the way. They leave
# `terminated` of the single step. So an item that reaches the crash after two or three steps has the state of the crash as
# its next observation, holds the reward of the crash, and is not terminated. The losses of the package read
# ("next", "terminated") and steps_to_next_obs, and add a discounted value of the crashed state to the target. The key
# `nonterminal`, which MultiStep also writes, is true for these items, and no loss reads it. The documentation says that the
# end keys are left untouched, and not that targets need more. It matters to whoever trains DQN, SAC or TD3 with n > 1 where
# episodes end by collisions. Exits 0 as long as that is so.
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
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, MultiStep, ReplayBuffer
from torchrl.envs import MultiStepTransform
from torchrl.objectives.value import TD0Estimator

STEPS, GAMMA, VALUE = 3, 0.5, 100.0
REWARDS = [1.0, 1.0, 1.0, 1.0, -10.0]  # of an episode of five steps; the last is a crash
EPISODES = 3


def collected():
    """Episodes one after the other; an observation is the number of steps since the start, 5 is the crashed car."""
    length = len(REWARDS)
    time = torch.arange(length).repeat(EPISODES)[:, None].float()
    end = time == length - 1
    after = TensorDict(
        observation=time + 1,
        reward=torch.tensor(REWARDS).repeat(EPISODES)[:, None],
        done=end,
        terminated=end.clone(),
        truncated=torch.zeros_like(end),
        batch_size=len(time),
    )
    return TensorDict(observation=time, next=after, batch_size=len(time))


def expected(start):
    """The target of the step, by the definition of the n-step return: no value behind the end."""
    last = min(start + STEPS, len(REWARDS))
    total = sum(GAMMA ** (step - start) * REWARDS[step] for step in range(start, last))
    return total + (GAMMA**STEPS * VALUE if last < len(REWARDS) else 0.0)


def by_transform():
    buffer = ReplayBuffer(storage=LazyTensorStorage(100), transform=MultiStepTransform(n_steps=STEPS, gamma=GAMMA))
    buffer.extend(collected())
    return buffer[: len(REWARDS)]


def by_collector():
    return MultiStep(n_steps=STEPS, gamma=GAMMA)(collected())[: len(REWARDS)]


print("torchrl", version("torchrl"), "tensordict", version("tensordict"))
print(f"{STEPS} steps, discount {GAMMA}, a value of {VALUE:g} for every observation")
critic = TensorDictModule(lambda x: torch.full_like(x, VALUE), in_keys=["observation"], out_keys=["state_value"])
estimator = TD0Estimator(gamma=GAMMA, value_network=critic)
good = True
for make in (by_transform, by_collector):
    data = make()
    target = estimator.value_estimate(data.clone())
    print(make.__name__)
    wrong = []
    for step in range(len(REWARDS)):
        after = data[step]["next"]
        seen = target[step].item()
        print(
            f"  observation {step} -> {after['observation'].item():g}, reward {after['reward'].item():g},"
            f" terminated {after['terminated'].item()}, nonterminal {data[step]['nonterminal'].item()}:"
            f" target {seen:g}, by the definition {expected(step):g}"
        )
        if abs(seen - expected(step)) > 1e-4:
            assert after["observation"].item() == len(REWARDS) and not after["terminated"].item()
            wrong.append(step)
    good &= wrong == [2, 3]
sys.exit(0 if good else 1)
PYTHON
"$folder/venv/bin/python" "$folder/program.py" > "$folder/out" 2> "$folder/log" || { cat "$folder/out" "$folder/log"; exit 1; }
grep -v INFO "$folder/out"
