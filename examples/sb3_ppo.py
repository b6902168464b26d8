"""Stable-Baselines3's PPO in attacked traffic: `python examples/sb3_ppo.py [STEPS]
[POLICY.pt]` (extra gym).

Half of the episodes are nominal, half attacked by e2 at an intensity of 1; an action
lasts 0.2 s. POLICY.monitor.csv gets return, length and end of every episode.
"""

import sys

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import e2rl


def main(
    steps: str = "100000", file: str = "ppo.pt", num_envs: int = 64, **settings
) -> None:
    """Train a new policy and write it; settings: of e2rl.make_env."""
    env = e2rl.make_sb3_env(num_envs, hold=2, **settings)
    env = VecMonitor(
        env,
        file.removesuffix(".pt"),
        info_keywords=("contact", "off_road", "progress", "eta"),
    )
    narrow = {
        "log_std_init": -2.0
    }  # 0.2 rad/s of exploration; by default it is 1.6 rad/s, off any road at once
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=32,
        batch_size=256,
        gamma=0.97,
        policy_kwargs=narrow,
        device="cpu",
        seed=0,
    )
    model.learn(int(steps))
    e2rl.save_policy(model, file)
    print(f"measure it by: python evaluate.py ego=policy_file ego.file={file}")


if __name__ == "__main__":
    main(*sys.argv[1:])
