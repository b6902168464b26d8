"""`PYTHON benchmarks/peers.py NAME REPEATS`: agent-steps per CPU second of another
simulator, as JSON, one thread.

Run by `peer.py` in an interpreter that has the peer (extra `peers`), so nothing of e2rl
is imported. Every peer moves about 32 vehicles a scene at 0.1 s a step and does what
its own step does; `work` says what that is.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version

AGENTS = 32
STEPS = 20
Measured = tuple[
    int, int, str, float
]  # scenes at once, agents a scene, work, agent-steps per CPU second


def best(function: Callable[[], int], repeats: int) -> float:
    """Most agent-steps per second on a core (whoever else is on the machine) of the
    repeats, after one call that is not counted; function returns agent-steps."""
    function()
    rates = []
    for _ in range(repeats):
        begin = time.process_time()
        rates.append(function() / (time.process_time() - begin))
    return max(rates)


def highway_env(repeats: int) -> Iterator[Measured]:
    """One scene; the others drive by IDM and MOBIL, as they always do there."""
    import gymnasium
    import highway_env  # noqa: F401 - registers its environments

    env = gymnasium.make(
        "highway-v0",
        config={
            "vehicles_count": AGENTS - 1,
            "simulation_frequency": 10,
            "policy_frequency": 10,
            "duration": 10 * STEPS,
            "observation": {"type": "Kinematics", "vehicles_count": 13},
        },
    )

    def steps() -> int:
        env.reset(seed=0)
        for _ in range(STEPS):
            *_, ended, cut, _ = env.step(1)
            if ended or cut:
                env.reset(seed=0)
        return STEPS * AGENTS

    yield (
        1,
        AGENTS,
        "IDM and MOBIL traffic, collisions, observation of the ego",
        best(steps, repeats),
    )


def vmas(repeats: int) -> Iterator[Measured]:
    """Its lanelet road scenario has 20 agents at most."""
    import torch
    import vmas as library

    torch.set_num_threads(1)
    for batch in (1, 32, 256):
        env = library.make_env(
            "road_traffic", num_envs=batch, device="cpu", n_agents=20, seed=0
        )
        env.reset()
        action = [torch.zeros(batch, agent.action_size) for agent in env.agents]

        def steps(env=env, action=action, batch=batch) -> int:
            for _ in range(STEPS // 4):
                env.step(action)
            return STEPS // 4 * batch * len(action)

        yield (
            batch,
            20,
            "bicycle of all, collisions, observation of all",
            best(steps, repeats),
        )


def torchdrivesim(repeats: int) -> Iterator[Measured]:
    """On a square of 400 triangles; its default collisions."""
    import torch
    from torchdrivesim.kinematic import KinematicBicycle
    from torchdrivesim.mesh import BaseMesh, BirdviewMesh
    from torchdrivesim.rendering.base import DummyRendererConfig
    from torchdrivesim.simulator import Simulator, TorchDriveConfig

    torch.set_num_threads(1)
    side = 400.0
    cells = 14
    axis = torch.linspace(-side / 2, side / 2, cells + 1)
    vertices = torch.cartesian_prod(axis, axis)
    corner = (
        torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)
    ).flatten()
    faces = torch.cat(
        [
            corner[:, None] + torch.tensor([0, 1, cells + 1]),
            corner[:, None] + torch.tensor([1, cells + 2, cells + 1]),
        ]
    )
    for batch in (1, 16):
        mesh = BirdviewMesh.set_properties(
            BaseMesh(verts=vertices[None], faces=faces[None]), "road"
        ).expand(batch)
        spot = 12.0 * torch.cartesian_prod(torch.arange(8.0), torch.arange(4.0)).expand(
            batch, -1, -1
        )
        kinematic = KinematicBicycle()
        kinematic.set_params(lr=1.5 * torch.ones(batch, AGENTS))
        kinematic.set_state(torch.cat([spot, torch.zeros(batch, AGENTS, 2)], -1))
        config = TorchDriveConfig(renderer=DummyRendererConfig())
        size = torch.tensor([4.5, 2.0]).expand(batch, AGENTS, 2)
        simulator = Simulator(
            mesh,
            {"vehicle": kinematic},
            {"vehicle": size},
            {"vehicle": torch.ones(batch, AGENTS, dtype=torch.bool)},
            config,
        )
        action = {"vehicle": torch.zeros(batch, AGENTS, 2)}

        def steps(simulator=simulator, action=action, batch=batch) -> int:
            with torch.no_grad():
                for _ in range(STEPS // 4):
                    simulator.step(action)
                    simulator.compute_collision(), simulator.compute_offroad()
            return STEPS // 4 * batch * AGENTS

        yield (
            batch,
            AGENTS,
            "bicycle of all, collisions, off-road of all, no observation",
            best(steps, repeats),
        )


PEERS = {
    "highway_env": ("highway-env", highway_env),
    "vmas": ("vmas", vmas),
    "torchdrivesim": ("torchdrivesim", torchdrivesim),
}


if __name__ == "__main__":
    name = sys.argv[1]
    repeats = int(sys.argv[2])
    if name not in PEERS:
        sys.exit(f"{name} is not on the package index, so that nothing here runs it")
    package, measure = PEERS[name]
    try:
        print(json.dumps({"version": version(package), "rows": list(measure(repeats))}))
    except PackageNotFoundError:
        sys.exit(f"{package} is not installed for {sys.executable}")
