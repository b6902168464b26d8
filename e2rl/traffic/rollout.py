"""Closed-loop rollouts of scenes with an ego and live traffic, for evaluation and for
D'."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from e2rl.planners.ego import Ego
from e2rl.planners.ego_policy import EgoPolicy
from e2rl.prior.routes import take_route
from e2rl.scenes.route import BEHIND, SPACING, project_track
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import DrivingEnv
from e2rl.sim.mission import Mission, mission_of, ran_red
from e2rl.sim.rollouts import Rollouts
from e2rl.sim.settings import SimSettings
from e2rl.traffic.attempt import attempt
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.traffic import PlanLog, Traffic, counted_nfe
from e2rl.traffic.transform import AdversarialSynthesizer

SYNTHESIZED = ("states", "valid", "adversaries", "contact")  # fields of D'
NOISE_STEP = 1_000_003  # between the noise of a scene in two rounds


@torch.no_grad()
def roll_out(
    scenes: SceneSet,
    index: Tensor,
    seed: Tensor,
    eta: Tensor,
    *,
    ego: Ego,
    traffic: Traffic,
    sim: SimSettings,
    device: str = "cpu",
    decisions: Tensor | None = None,
) -> Rollouts:
    """Returns rollouts of B scenes to their last step, on through contacts and off the
    road.

    Args:
        scenes: of which some are driven.
        index: [B] int64, which.
        seed: [B] int64, of the noise.
        eta: [B], intensities.
        ego: drives.
        traffic: drives the other vehicles.
        sim: settings of the simulator.
        device: where it runs.
        decisions: [B, D], of the attack (None: by rule).
    """
    start = time.perf_counter()
    settings = replace(
        sim,
        end_on_contact=False,
        end_off_road=False,
        end_when_gone=False,
        replay_ego=sim.replay_ego or ego.replays_log,
    )
    pool = TrafficPool.live(
        index.cpu(),
        eta.cpu().float(),
        seed=seed.cpu(),
        decisions=None if decisions is None else decisions.cpu(),
    )
    base = DrivingEnv(
        scenes,
        settings,
        batch_size=len(index),
        device=device,
        agents=True,
        observed=type(ego).act is not Ego.act,
    )
    synthesizer = AdversarialSynthesizer(
        pool,
        torch.arange,
        traffic=traffic,
        ego=ego,
    )
    log = PlanLog()
    synthesizer.on_plan = log
    env = TransformedEnv(base, synthesizer)
    with (
        set_exploration_type(ExplorationType.DETERMINISTIC),
        counted_nfe(traffic) as nfe,
    ):
        steps = env.rollout(base.horizon, EgoPolicy(ego, env))
    columns = _driven(steps, base.scene, log=log) | log.plans(steps["ego", "plan"])
    seconds = time.perf_counter() - start
    return Rollouts.in_scenes(
        scenes,
        index,
        scene=base.scene,
        replays_ego=settings.replay_ego,
        seed=seed,
        eta=eta.double(),
        seconds=torch.full((len(index),), seconds / len(index)),
        nfe=torch.full((len(index),), float(sum(nfe)) / len(index)),
        **columns,
    )


def _driven(
    steps: TensorDictBase,
    scene: TensorDictBase,
    log: PlanLog,
) -> dict[str, Tensor]:
    """Fields of Rollouts from the frames [B, T] of a rollout."""
    agents = steps["next", "agents"]
    route = log.routes(scene)
    tracks = {
        name: torch.cat([steps["agents", name][:, :1], agents[name]], 1)
        for name in ("states", "valid")
    }
    others = tracks["states"].shape[2] - route.shape[1]
    return {
        **tracks,
        **log.transport(),
        "adversaries": pad(log.acted, (0, others)),
        "routes": route,
        "ran_light": red_lights(tracks, scene, route=route),
        "speed_limit": limits(
            tracks["states"][:, :, 0, :2],
            tracks["valid"][:, :, 0],
            mission=mission_of(scene),
        ),
        "contact": steps["next", "metrics", "contact"].any(1)[:, 0],
    }


def limits(
    points: Tensor,
    recorded: Tensor,
    mission: Mission,
) -> Tensor:
    """Speed limit [B, K] [m/s] along missions at the places of egos at points [B, K,
    2], the last one where they are not recorded [B, K]; 0 unknown."""
    s, _, _ = project_track(
        points,
        mission.points,
        known=recorded,
        start=BEHIND,
    )
    index = (s / SPACING).long().clamp(0, mission.limit.shape[1] - 1)
    return mission.limit.gather(1, index)


def red_lights(
    tracks: dict[str, Tensor],
    scene: TensorDictBase,
    route: Tensor,
) -> Tensor:
    """Step [B, N] int64 at which each vehicle last crossed a stop line of its route [B,
    V] at red, -1 for never."""
    result = torch.full_like(tracks["valid"][:, 0], -1, dtype=torch.int64)
    lights = take_route(scene["route_light"], route.clamp(min=0))
    followed = scene["valid"][:, : route.shape[1]] & (route >= 0)
    b, v = (followed & (lights >= 0).any(-1)).nonzero(as_tuple=True)
    if len(b):
        chosen = (b, v, route[b, v])
        valid = tracks["valid"][b, :, v]
        s, _, _ = project_track(
            tracks["states"][b, :, v, :2],
            scene["route_points"][chosen],
            known=valid,
            start=BEHIND,
        )
        front = (s + scene["size"][b, v, :1] / 2).cummax(1).values
        result[b, v] = ran_red(
            scene["light_state"][b],
            lights[b, v],
            line=scene["route_light_s"][chosen],
            front=front.masked_fill(~valid, -torch.inf),
        )
    return result


def synthesize_traffic(
    scenes: SceneSet,
    traffic: Traffic,
    *,
    sim: SimSettings,
    batch: int = 64,
    device: str = "cpu",
) -> Callable[[Ego, Tensor, Tensor | float, int], dict[str, Any]]:
    """Returns a function (ego, scene_index [S], eta [S] or one for all, seed) -> the D'
    of Algorithm 1 against that ego.

    D': scene_index [K], states [K, T+1, N, 4], valid [K, T+1, N], adversaries [K, N],
    contact [K] (the ego touched a vehicle), and errored {position in S: why} of the
    S - K rows in which the ego or the traffic raised or became NaN.

    Args:
        scenes: that scene_index counts.
        traffic: drives all vehicles but the ego.
        sim: settings of the simulator.
        batch: scenes rolled out at a time.
        device: where it runs.
    """
    scene = scenes.batch([0])[:0]
    valid = scene["logged_valid"]
    empty = (scene["logged"], valid, valid[:, 0], valid[:, 0, 0])
    nothing = dict(zip(SYNTHESIZED, empty, strict=True))

    def synthesize(
        ego: Ego,
        scene_index: Tensor,
        eta: Tensor | float,
        seed: int,
    ) -> dict[str, Any]:
        etas = torch.as_tensor(eta, dtype=torch.float32).expand(len(scene_index))

        def roll_out_rows(rows: Sequence[int]) -> Rollouts:
            index = scene_index[list(rows)]
            return roll_out(
                scenes,
                index,
                seed=index + seed * NOISE_STEP,
                eta=etas[list(rows)],
                ego=ego,
                traffic=traffic,
                sim=sim,
                device=device,
            )

        driven: list[int] = []
        parts = list[Rollouts]()
        errored = dict[int, dict]()
        for rows in torch.arange(len(scene_index)).split(batch):
            begins = not (driven or errored)
            good, bad = attempt(roll_out_rows, rows.tolist(), begins=begins)
            for tasks, part in good:
                driven += tasks
                parts.append(part)
            errored |= dict(bad)
        position = torch.tensor(driven, dtype=torch.int64)
        order = position.argsort()
        columns = {
            name: torch.cat([empty, *(part.get(name) for part in parts)])[order]
            for name, empty in nothing.items()
        }
        index = scene_index[position[order]]
        return columns | {"scene_index": index, "errored": errored}

    return synthesize
