"""Small parts for the learning tests: a few agents, trivial attackers, quick settings."""

import torch
from e2rl.scripts.train import train_round

from e2rl.learning.rounds.evolution import Evolution, RoundSettings
from e2rl.learning.rounds.memory import Memory
from e2rl.learning.rounds.policy import PolicyImprovement
from e2rl.learning.rounds.schedules import AdaptiveCurriculum
from e2rl.planners.actor import ActorEgo
from e2rl.sim.settings import SimSettings
from e2rl.traffic.traffic import Traffic, TrafficPlan, keep_velocity
from tests.synthetic import make_scenes


def small_scenes(num_scenes=4, steps=20, **kwargs):
    sizes = {
        "max_vehicles": 4,
        "max_agents": 5,
        "num_routes": 1,
        "num_points": 120,
        "num_vehicles": 3,
        "num_vrus": 1,
    }
    return make_scenes(num_scenes, steps=steps, **(sizes | kwargs))


def brake_check(scenes):
    """A trivial synthesizer: vehicle 1 is put into the ego's lane `40 / (1 + eta)` m
    ahead, at half the ego's speed."""

    def synthesize(ego, index, eta, seed):
        scene = scenes.batch(index)
        states = scene["logged"].clone()
        valid = scene["logged_valid"].clone()
        time = 0.1 * torch.arange(states.shape[1])
        speed = states[:, :1, 0, 3] / 2
        eta = torch.as_tensor(eta, dtype=torch.float32).expand(len(index))
        states[:, :, 1, 0] = (
            states[:, :1, 0, 0] + 40 / (1 + eta[:, None]) + speed * time
        )
        states[:, :, 1, 1], states[:, :, 1, 3] = 0.0, speed
        adversaries = torch.zeros(len(index), states.shape[2], dtype=torch.bool)
        adversaries[:, 1] = eta > 0
        return {
            "scene_index": index,
            "states": states,
            "valid": valid,
            "adversaries": adversaries,
            "contact": eta > 1,
        }

    return synthesize


class Ambush(Traffic):
    """A trivial reacting method: where eta is positive, vehicle 1 is put where the ego
    plans to be in 0.5 s; the others keep their velocity."""

    def reset(self, scenes, seed, eta):
        return eta

    def replan(self, state, world, ego_plan):
        vehicles = world.scene["route_log"].shape[1]
        states = keep_velocity(world.states[:, :vehicles])
        attacked = state > 0
        acting = torch.zeros_like(world.valid[:, :vehicles])
        states[attacked, 1] = ego_plan[attacked, 4:5]
        acting[:, 1] = attacked
        present = world.valid[:, :vehicles, None].expand(states.shape[:-1])
        return state, TrafficPlan(states, present, adversary=acting)


def small_run(
    seed=0,
    hidden=(16,),
    nominal="log",
    rounds=4,
    scenes=None,
    collect=None,
    evades=False,
    device="cpu",
    spread=0.0,
    folder=None,
    memory=4096,
    prefetch=False,
    **ppo,
):
    """evades: a planner evades for the actor; folder: of the run, where `memory` rows
    are remembered."""
    torch.manual_seed(seed)
    scenes = scenes or small_scenes()
    improve = PolicyImprovement(
        ActorEgo(hidden=hidden, room=2.0 if evades else None, evades=evades),
        scenes,
        sim=SimSettings(),
        seed=seed,
        collect={"batch": 4, "steps": 20, "hold": 1, "iterations": 2} | (collect or {}),
        ppo={"minibatch": 64, "epochs": 2, "critic_warmup": 0, "target_kl": 1.0} | ppo,
        rounds=rounds,
        device=device,
    )
    return Evolution(
        AdaptiveCurriculum(len(scenes), rounds, seed, spread=spread),
        improve,
        attacks=[brake_check(scenes)],
        settings=RoundSettings(
            scenes=3,
            nominal=nominal,
            memory=memory,
            prefetch=prefetch,
        ),
        seed=seed,
        memory=Memory(folder, memory),
    )


def steady(metrics):
    """The metrics of a round that do not depend on the machine."""
    return {
        name: value
        for name, value in metrics.items()
        if "time/" not in name and "seconds" not in name
    }


def rounds(run, count):
    """The steady metrics of so many rounds."""
    return [steady(train_round(run)) for _ in range(count)]
