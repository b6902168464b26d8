"""Closed-loop rollouts of scenes with an ego and live traffic, for evaluation and for
D'."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from e2rl.planners.ego import Ego
from e2rl.planners.ego_policy import EgoPolicy
from e2rl.prior.routes import take_route
from e2rl.scenes.route import BEHIND, SPACING, project_track
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.sim.mission import Mission, mission_of, ran_red
from e2rl.sim.rollouts import Rollouts
from e2rl.traffic.attempt import attempt
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.traffic import PlanLog, Traffic, counted_nfe
from e2rl.traffic.transform import AdversarialSynthesizer

MADE = ("states", "valid", "adversaries", "contact")  # what D' has of its rollouts


@torch.no_grad()
def roll_out(
    scenes: SceneSet,
    index: Tensor,
    seed: Tensor,
    eta: Tensor,
    ego: Ego,
    traffic: Traffic,
    sim: SimSettings,
    device: str = "cpu",
    decisions: Tensor | None = None,
) -> Rollouts:
    """Rollouts of scenes `index` [B] int64 to their last step, on through contacts and
    off the road.

    Args:
        seed: [B] int64, of the noise.
        eta: [B], intensities.
        decisions: [B, D], of the attack (None: by rule).
    """
    begin = time.perf_counter()
    settings = replace(
        sim, end_on_contact=False, end_off_road=False, end_when_gone=False
    )
    settings.replay_ego = sim.replay_ego or ego.replays_log
    pool = TrafficPool.live(
        index.cpu(),
        eta.cpu().float(),
        seed=seed.cpu(),
        decisions=None if decisions is None else decisions.cpu(),
    )
    looks = type(ego).act is not Ego.act
    base = DrivingEnv(scenes, settings, len(index), device, agents=True, observed=looks)
    synthesizer = AdversarialSynthesizer(pool, torch.arange, traffic=traffic, ego=ego)
    log = PlanLog()
    synthesizer.on_plan = log
    env = TransformedEnv(base, synthesizer)
    with (
        set_exploration_type(ExplorationType.DETERMINISTIC),
        counted_nfe(traffic) as nfe,
    ):
        steps = env.rollout(base.horizon, EgoPolicy(ego, env))
    known = _driven(steps, base.scene, log=log) | log.plans(steps["ego", "plan"])
    cost = {"seconds": time.perf_counter() - begin, "nfe": float(sum(nfe))}
    known |= {
        name: torch.full((len(index),), value / len(index))
        for name, value in cost.items()
    }
    known |= {"seed": seed, "eta": eta.double()}
    return Rollouts.in_scenes(
        scenes, index, scene=base.scene, replays_ego=settings.replay_ego, **known
    )


def _driven(
    steps: TensorDictBase, scene: TensorDictBase, log: PlanLog
) -> dict[str, Tensor]:
    """Fields of Rollouts from the frames [B, T] of a rollout."""
    agents = steps["next", "agents"]
    route = log.routes(scene)
    tracks = {
        name: torch.cat([steps["agents", name][:, :1], agents[name]], 1)
        for name in ("states", "valid")
    }
    return {
        **tracks,
        "adversaries": torch.nn.functional.pad(
            log.acted, (0, tracks["states"].shape[2] - route.shape[1])
        ),
        "routes": route,
        "ran_light": red_lights(tracks, scene, route=route),
        "speed_limit": limits(
            tracks["states"][:, :, 0, :2],
            tracks["valid"][:, :, 0],
            mission=mission_of(scene),
        ),
        **log.transport(),
        "contact": steps["next", "metrics", "contact"].any(1)[:, 0],
    }


def limits(points: Tensor, known: Tensor, mission: Mission) -> Tensor:
    """Speed limit [B, K] [m/s] along missions at the places of egos at points [B, K,
    2], the last known one where they are unknown; 0 unknown."""
    s, _, _ = project_track(points, mission.points, known=known, start=BEHIND)
    return mission.limit.gather(
        1, (s / SPACING).long().clamp(0, mission.limit.shape[1] - 1)
    )


def red_lights(
    tracks: dict[str, Tensor], scene: TensorDictBase, route: Tensor
) -> Tensor:
    """Step [B, N] int64 at which each vehicle last crossed a stop line of its route [B,
    V] at red, -1 for never."""
    result = torch.full_like(tracks["valid"][:, 0], -1, dtype=torch.int64)
    lights = take_route(scene["route_light"], route.clamp(min=0))
    b, v = (
        scene["valid"][:, : route.shape[1]] & (route >= 0) & (lights >= 0).any(-1)
    ).nonzero(as_tuple=True)
    if len(b):
        chosen = b, v, route[b, v]
        seen = tracks["valid"][b, :, v]
        s, _, _ = project_track(
            tracks["states"][b, :, v, :2],
            scene["route_points"][chosen],
            known=seen,
            start=BEHIND,
        )
        front = (s + scene["size"][b, v, :1] / 2).cummax(1).values
        front = front.masked_fill(~tracks["valid"][b, :, v], -torch.inf)
        result[b, v] = ran_red(
            scene["light_state"][b],
            lights[b, v],
            line=scene["route_light_s"][chosen],
            front=front,
        )
    return result


def synthesize_traffic(
    scenes: SceneSet,
    traffic: Traffic,
    sim: SimSettings,
    batch: int = 64,
    device: str = "cpu",
):
    """A function (ego, scene_index [S], eta [S] or one for all, seed) -> the D' of
    Algorithm 1 against that ego.

    D': scene_index [K], states [K, T+1, N, 4], valid [K, T+1, N], adversaries [K, N],
    contact [K] (the ego touched a vehicle), and errored {position in S: why} of the
    S - K rows in which the ego or the traffic raised or became NaN.
    """
    scene = scenes.batch([0])[:0]
    valid = scene["logged_valid"]
    nothing = dict(
        zip(MADE, (scene["logged"], valid, valid[:, 0], valid[:, 0, 0]), strict=True)
    )

    def synthesize(
        ego: Ego, scene_index: Tensor, eta: Tensor | float, seed: int
    ) -> dict[str, Any]:
        etas = torch.as_tensor(eta, dtype=torch.float32).expand(len(scene_index))

        def roll_out_rows(rows: Sequence[int]) -> Rollouts:
            index = scene_index[list(rows)]
            at = list(rows)
            noise = index + seed * 1_000_003
            return roll_out(
                scenes,
                index,
                seed=noise,
                eta=etas[at],
                ego=ego,
                traffic=traffic,
                sim=sim,
                device=device,
            )

        done: list[int] = []
        parts = list[Rollouts]()
        errored = dict[int, dict]()
        for rows in torch.arange(len(scene_index)).split(batch):
            found, lost = attempt(
                roll_out_rows, rows.tolist(), begins=not (done or errored)
            )
            done += [row for tasks, _ in found for row in tasks]
            parts += [part for _, part in found]
            errored |= dict(lost)
        at = torch.tensor(done, dtype=torch.int64)
        order = at.argsort()
        made = {
            name: torch.cat([nothing[name], *(part.get(name) for part in parts)])[order]
            for name in MADE
        }
        return made | {"scene_index": scene_index[at[order]], "errored": errored}

    return synthesize
