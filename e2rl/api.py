"""The library in a notebook: scenes, prior, traffic and ego by the names of their files
in conf/, rollouts and rows.

    import e2rl

    failure = e2rl.find_failures(ego="lane_graph", method="e2")[0]
    print(failure.row["scene_id"], "hit after", failure.row["contact_time"], "s;
    counts:", failure.row["counted"] == 1) e2rl.save_video(failure, "failure.gif")

Step by step:

    scenes = e2rl.load_scenes("bundled", num_scenes=8) traffic = e2rl.make_traffic("e2",
    e2rl.load_prior(), support="topology") rollouts = e2rl.roll_out(scenes,
    e2rl.make_ego("lane_graph"), traffic, eta=2.0) rows = e2rl.score(rollouts)

Keyword arguments are keys of the file, nested ones as mappings. Everything runs in this
process.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import TransformedEnv

from e2rl.driving.setup import Method, Setup, Task
from e2rl.evaluation.build import build_ego, build_prior, build_sim, build_traffic
from e2rl.metrics.score import score_rollouts
from e2rl.planners.ego import Ego
from e2rl.planners.policy_file import write_policy
from e2rl.prior.prior import Prior
from e2rl.report.picture import Replay
from e2rl.report.videos import save_animation
from e2rl.run.config import (
    check_choice,
    check_range,
    library,
    load_choice,
    with_changes,
)
from e2rl.run.errors import InputError
from e2rl.scenes import source
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import DrivingEnv
from e2rl.sim.rollout_file import Failure
from e2rl.sim.rollouts import Rollouts
from e2rl.sim.settings import SimSettings
from e2rl.traffic.fusing import prepare_fused
from e2rl.traffic.pool import RowDraw, TrafficPool
from e2rl.traffic.traffic import Traffic
from e2rl.traffic.transform import AdversarialSynthesizer

AT_ONCE = 4  # scenes that are driven together while failures are sought
SEEDS = 256  # of the noise, for each scene and intensity that a policy is trained in


def load_scenes(
    data: str = "bundled",
    num_scenes: int | None = None,
    scenes: str | None = None,
    **settings: Any,
) -> SceneSet:
    """Returns at most num_scenes scenes of conf/data/<data>.yaml, such as
    load_scenes("scenarionet", path="logs.zip").

    scenes: a list or the folder of a run, whose scenes are taken.
    """
    return source.load_scenes(
        _choice("data", data, settings={"workers": 1} | settings),
        num_scenes,
        scenes=scenes,
    )


def load_prior(
    checkpoint: str = "bundled", device: str = "cpu", **settings: Any
) -> Prior:
    """Returns the frozen prior of a checkpoint; settings: conf/prior/default.yaml, such
    as sampler={"steps": 8}."""
    config = _choice("prior", "default", settings={"checkpoint": checkpoint} | settings)
    return build_prior(OmegaConf.create({"prior": config}), device)[0]


def make_traffic(name: str, prior: Prior, **settings: Any) -> Traffic:
    """Returns the traffic method of conf/synthesizer/<name>.yaml on a prior."""
    return build_traffic(_choice("synthesizer", name, settings=settings), prior)


def make_ego(name: str, **settings: Any) -> Ego:
    """Returns the ego of conf/ego/<name>.yaml."""
    shared = {
        "sim": load_choice("sim", "default"),
        "device": "cpu",
    }  # that some egos refer to
    return build_ego(
        OmegaConf.create(shared | {"ego": _choice("ego", name, settings=settings)})
    )


def roll_out(
    scenes: SceneSet,
    ego: Ego,
    traffic: Traffic,
    eta: float = 0.0,
    seeds: Sequence[int] = (0,),
    device: str = "cpu",
) -> Rollouts:
    """Returns the rollouts of every scene under every sampling seed, as `e2rl evaluate`
    makes them.

    All are simulated at once. eta: adversarial intensity, 0 to 3. Raises InputError for
    a class in the place of an object.
    """
    check_objects(ego=ego, traffic=traffic)
    setup = Setup(
        scenes,
        ego,
        ego_name=type(ego).__name__,
        sim=SimSettings(),
        device=device,
    )
    tasks = [Task(scene, seed) for seed in seeds for scene in range(len(scenes))]
    return setup.roll_out(
        Method(type(traffic).__name__, traffic, eta=float(eta)), tasks
    )


def find_failures(
    ego: str | Ego = "lane_graph",
    method: str | Traffic = "e2",
    eta: float = 2.0,
    scenes: SceneSet | None = None,
    most: int = 1,
    seed: int = 0,
) -> list[Failure]:
    """Returns the first rollouts in which the ego is hit, at least `most` of them where
    there are so many.

    A few scenes are driven at a time, first one of each place, until enough failures
    are found.

    Args:
        ego: the planner, or the name of a file in conf/ego.
        method: the traffic, or the name of a file in conf/synthesizer, on the bundled
            prior.
        eta: adversarial intensity, 0 to 3.
        scenes: where to drive; None: the bundled test scenes.
        seed: of the sampling noise.

    Raises:
        InputError: for a class in the place of an object.
    """
    check_objects(ego=ego, method=method)
    scenes = load_scenes() if scenes is None else scenes
    planner = make_ego(ego) if isinstance(ego, str) else ego
    traffic = make_traffic(method, load_prior()) if isinstance(method, str) else method
    names = [
        part if isinstance(part, str) else type(part).__name__ for part in (ego, method)
    ]
    setup = Setup(scenes, planner, ego_name=names[0], sim=SimSettings())
    turns = [
        scenes.location[:scene].count(place)
        for scene, place in enumerate(scenes.location)
    ]
    order = sorted(range(len(scenes)), key=lambda scene: (turns[scene], scene))
    failures: list[Failure] = []
    for begin in range(0, len(order), AT_ONCE):
        tasks = [Task(scene, seed) for scene in order[begin : begin + AT_ONCE]]
        rollouts = setup.roll_out(Method(names[1], traffic, eta=float(eta)), tasks)
        rows = score_rollouts(rollouts)[0]
        failures += [
            Failure(rollouts.rollout(k), row)
            for k, row in enumerate(rows)
            if row["cfr"]
        ]
        if len(failures) >= most:
            break
    return failures


def check_objects(**arguments: Any) -> None:
    """Raises InputError for an argument that is a class, where an object of it is
    meant."""
    for name, value in arguments.items():
        if isinstance(value, type):
            kind = value.__name__
            raise InputError(f"{name}={kind}: is a class; give an object, {kind}(...)")


def make_env(
    num_envs: int = 16,
    scenes: SceneSet | None = None,
    method: str | Traffic = "e2",
    eta: float | Sequence[float] = (0.0, 1.0),
    hold: int = 1,
    seed: int | None = None,
    compile: bool | str = "auto",
    **sim: Any,
) -> TransformedEnv:
    """Returns TorchRL environments [num_envs] to train in, whose traffic is replanned
    against the policy every 0.5 s.

    Args:
        scenes: of which one is drawn for each episode; None: the bundled training
            scenes.
        method: the traffic, or the name of a file in conf/synthesizer, on the bundled
            prior.
        eta: adversarial intensity, 0 to 3, or several, of which one is drawn.
        hold: steps of 0.1 s that an action lasts.
        seed: of the scenes and attacks that are drawn, until `set_seed` or
            `reset(seed=...)`; None: others in each
            environment and process.
        compile: as in conf/evaluate.yaml, for the whole process.
        sim: settings of conf/sim/default.yaml, such as reward={"contact": -30.0}.
    """
    check_range("num_envs", num_envs, low=1)
    etas = torch.tensor(
        eta if isinstance(eta, Sequence) else [eta], dtype=torch.float32
    )
    scenes = load_scenes("bundled", split="train") if scenes is None else scenes
    traffic = make_traffic(method, load_prior()) if isinstance(method, str) else method
    settings = build_sim(
        OmegaConf.create({"sim": _choice("sim", "default", settings=sim)})
    )
    prepare_fused(OmegaConf.create({"compile": compile, "device": "cpu"}))
    row = torch.arange(len(etas) * SEEDS * len(scenes))
    pool = TrafficPool.live(
        row % len(scenes),
        etas.repeat_interleave(SEEDS * len(scenes)),
        seed=row,
    )
    draw = RowDraw(torch.ones(len(row), dtype=torch.float64), seed)
    base = DrivingEnv(scenes, settings, num_envs, hold=hold)
    return TransformedEnv(base, AdversarialSynthesizer(pool, draw, traffic=traffic))


def make_gym_env(
    num_envs: int | None = None, autoreset: str = "same_step", **settings: Any
) -> Any:
    """Returns a gymnasium.Env of one scene, or with num_envs a VectorEnv, one batch.

    Args:
        autoreset: when an environment of a batch begins anew: in the `same_step` as it
            ends, or in the `next_step`,
            whose action is ignored, as gymnasium's wrappers of a batch's observations want it.
        settings: of make_env.
    """
    module = library("e2rl.learning.adapters.gym_env", "make_gym_env", extra="gym")
    check_choice("autoreset", autoreset, choices=module.AUTORESET)
    if num_envs is None:
        return module.DrivingGymEnv(make_env(1, **settings))
    return module.DrivingVectorEnv(
        make_env(num_envs, **settings), module.AUTORESET[autoreset]
    )


def make_sb3_env(num_envs: int = 16, **settings: Any) -> Any:
    """Returns the batch as a VecEnv of Stable-Baselines3. settings: of make_env."""
    return library("e2rl.learning.adapters.sb3", "make_sb3_env", extra="gym").SB3Env(
        make_gym_env(num_envs, **settings)
    )


def save_policy(policy: Any, path: str | Path, env: Any = None) -> Path:
    """Writes POLICY.pt, TorchScript, for ego=policy_file; returns its path.

    Args:
        policy: a Stable-Baselines3 model trained here, or a module of such a map
            (docs/guide/policies.md).
        env: of a model that was loaded: the VecNormalize that was saved with it
            (docs/guide/policies.md).
    """
    if not isinstance(policy, torch.nn.Module):
        policy = library(
            "e2rl.learning.adapters.sb3",
            "save_policy",
            extra="gym",
        ).Deterministic(policy, env)
    write_policy(policy, Path(path))
    return Path(path)


def save_video(failure: Failure, path: str | Path) -> Path:
    """Writes the video of a failure, FILE.gif; returns its path."""
    save_animation(Path(path), Replay(failure.rollout, failure.row).frames())
    return Path(path)


def score(rollouts: Rollouts) -> list[dict]:
    """Returns one row of metrics per rollout (docs/reference/metrics.md)."""
    return score_rollouts(rollouts)[0]


def _choice(group: str, name: str, settings: dict[str, Any]) -> DictConfig:
    """A file of the configuration with changes."""
    return with_changes(
        load_choice(group, name),
        settings,
        where=f"{group}={name}",
        group=group,
    )
