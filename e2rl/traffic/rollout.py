"""Closed-loop rollouts of scenes with an ego and synthesized traffic: what evaluation measures and D' is made of."""

import time
from dataclasses import replace

import torch
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from e2rl.ego.base import Ego, EgoPolicy
from e2rl.scene.recording import VEHICLE
from e2rl.scene.scene import SceneSet
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.synthesizer.synthesizer import Synthesizer
from e2rl.traffic.transform import AdversarialSynthesizer

MAP_KEYS = ("lane_points", "lane_index", "lane_width", "drivable_points", "drivable_index")


@torch.no_grad()
def roll_out(
    scenes: SceneSet,
    index: Tensor,
    seed: Tensor,
    eta: Tensor,
    ego: Ego,
    synthesizer: Synthesizer,
    sim: SimSettings,
    replan: int = 5,
    device: str = "cpu",
) -> dict:
    """Rollouts of scenes index [B] with seeds [B] and intensities eta [B] to their last step.

    The rollout dict that e2rl.metrics and e2rl.evaluation.files read: states [B, T+1, N, 4], valid, size, agent_type,
    simulated, adversaries, logged, logged_valid, map keys, seed, scene_id, location, seconds (wall time a rollout) and
    the transport (path KL of adversaries and others, anchor jump), plus routes [B, V].
    """
    begin = time.perf_counter()
    settings = replace(sim, end_on_contact=False, end_off_road=False)
    transform = AdversarialSynthesizer(synthesizer, ego, lambda count: (index, seed, eta), replan)
    env = TransformedEnv(DrivingEnv(scenes, settings, len(index), device), transform)
    policy = EgoPolicy(ego, env)
    states, valid = [], []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = env.reset()
        world = env.base_env.world()
        states.append(world.states), valid.append(world.valid)
        contact = torch.zeros(len(index), dtype=torch.bool, device=world.states.device)
        for _ in range(env.base_env.horizon):
            tensordict = step_mdp(env.step(policy(tensordict)))
            contact = contact | tensordict["metrics", "contact"][:, 0]
            world = env.base_env.world()
            states.append(world.states), valid.append(world.valid)
    rollout = _rollout(
        scenes,
        index,
        seed,
        torch.stack(states, 1),
        torch.stack(valid, 1),
        world.scene,
        transform.episode,
        (time.perf_counter() - begin) / len(index),
        settings.replay_ego,
    )
    return rollout | {"contact": contact.cpu()}


def synthesize_traffic(
    scenes: SceneSet, synthesizer: Synthesizer, sim: SimSettings, batch: int = 64, device: str = "cpu"
):
    """A function (ego, scene_index [S], eta, seed) -> the D' of Algorithm 1 against that ego: scene_index, states
    [S, T+1, N, 4], valid, adversaries [S, N], contact [S] (the ego was hit by or hit a vehicle) and route [S, V]."""

    def synthesize(ego: Ego, scene_index: Tensor, eta: float, seed: int) -> dict[str, Tensor]:
        parts = []
        for rows in scene_index.split(batch):
            noise = rows + seed * 1_000_003
            parts.append(
                roll_out(
                    scenes, rows, noise, torch.full((len(rows),), float(eta)), ego, synthesizer, sim, device=device
                )
            )
        names = {
            "states": "states",
            "valid": "valid",
            "adversaries": "adversaries",
            "contact": "contact",
            "route": "routes",
        }
        return {"scene_index": scene_index} | {
            name: torch.cat([part[key] for part in parts]) for name, key in names.items()
        }

    return synthesize


def _rollout(scenes: SceneSet, index, seed, states, valid, scene, episode, seconds: float, replayed: bool) -> dict:
    agents, vehicles = states.shape[2], episode.adversaries.shape[1]
    start = scene["valid"]
    simulated = start & (torch.arange(agents, device=start.device) < vehicles) & (scene["agent_type"] == VEHICLE)
    simulated[:, 0] &= not replayed
    adversaries = torch.zeros_like(start)
    adversaries[:, :vehicles] = episode.adversaries
    acted = episode.adversaries
    rollout = {
        "states": states,
        "valid": valid,
        "size": scene["size"],
        "agent_type": scene["agent_type"],
        "parked": scene["parked"],
        "simulated": simulated,
        "adversaries": adversaries,
        "logged": scene["logged"],
        "logged_valid": scene["logged_valid"] & start[:, None],
        **{key: scene[key] for key in MAP_KEYS},
        "seed": seed,
        "seconds": torch.full((len(index),), seconds),
        "routes": episode.routed.route,
        "transport_adversary": (episode.kl * acted).sum(-1),
        "transport_others": (episode.kl * ~acted).sum(-1),
        "transport_anchor": episode.jump.sum(-1),
    }
    rollout = {key: value.cpu() for key, value in rollout.items()}
    where = index.tolist()
    return rollout | {"scene_id": [scenes.scene_id[i] for i in where], "location": [scenes.location[i] for i in where]}
