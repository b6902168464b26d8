"""Open-loop accuracy of traffic models: plans from causal start states, the ego unknown, against the log."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.evaluation.files import command_line, git_commit
from e2rl.evaluation.protocol import Method
from e2rl.metrics.catalogue import OPEN_LOOP_STAGE
from e2rl.metrics.displacement import scene_displacements
from e2rl.metrics.statistics import bootstrap_draws, cluster_index, interval, resampled_means
from e2rl.prior.lane_relative import HORIZON, SIZE
from e2rl.prior.stratified_sampling import main_direction, stratified_noise, stratified_uniform
from e2rl.scene.recording import VEHICLE
from e2rl.scene.scene import SceneSet
from e2rl.sim.world import World
from e2rl.synthesizer.episode import noise_of
from e2rl.synthesizer.synthesizer import Synthesizer
from e2rl.traffic.constant_velocity import straight_on
from e2rl.traffic.traffic import Baseline

HORIZONS = (3.0, 5.0)  # s
EGO = "unknown"  # of the rows: nobody is told the ego's plan
BATCH = 32  # scenes planned at once


@torch.no_grad()
def open_loop_rows(scenes: SceneSet, methods: list[Method], samples: int, device: str = "cpu") -> list[dict]:
    """Rows of metrics.json, stage `open loop`, of every method that predicts: minADE, mean and joint ADE over `samples`
    and their ratios to constant velocity's ADE on the same vehicles, with intervals by place."""
    rows = []
    for method in methods:
        baseline = isinstance(method.synthesizer, Baseline)
        if method.eta > 0 or (baseline and not method.synthesizer.predicts):
            continue
        count = 1 if baseline else samples
        parts = []
        for index in torch.arange(len(scenes)).split(BATCH):
            scene = scenes.batch(index).to(device)
            seed = index.to(device) + 1_000_003 * torch.arange(count, device=device)[:, None]
            parts.append(_displacements(scene, sample_plans(method.synthesizer, scene, seed)))
        columns = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        rows.append(
            {
                "dataset": scenes.dataset,
                "split": scenes.split,
                "method": method.name,
                "ego": EGO,
                "eta": method.eta,
                "n_scenes": len(scenes),
                "n_seeds": count,
                "n_rollouts": len(scenes) * count,
                "git": git_commit(),
                "command": command_line(),
                "stage": OPEN_LOOP_STAGE,
                "metrics": _summary(columns, scenes),
                "paired": {},
            }
        )
    return rows


def sample_plans(synthesizer: Synthesizer | Baseline, scene: TensorDictBase, seed: Tensor) -> Tensor:
    """Joint plans [B, S, V, HORIZON, 4] of scenes [B] from their start states; seed [S, B] int64.

    The prior's samples are stratified (prior/stratified_sampling.py) and stand as drawn: the acceleration bounds belong
    to the executed half second, and the present ones held over 5 s would make them a tenth less accurate.
    """
    if isinstance(synthesizer, Baseline):
        return torch.stack([_straight_plan(synthesizer, scene, one) for one in seed], 1)
    prior, (count, batch), vehicles = synthesizer.prior, seed.shape, scene["route_log"].shape[1]
    draw = lambda number, *shape, uniform=False: noise_of(  # noqa: E731
        seed.flatten(), torch.full((count * batch,), number), shape, uniform
    ).unflatten(0, (count, batch))
    order, place = draw(0, 2, vehicles, uniform=True).unbind(2), draw(2, 2, vehicles, uniform=True)[0].unbind(1)
    noise = draw(1, prior.sampler.steps, vehicles, SIZE).transpose(1, 2)
    noise = stratified_noise(noise, main_direction(prior.schedule, prior.sampler, noise.device), order[1], place[1])
    plans = []
    for uniform, one in zip(stratified_uniform(order[0], place[0]), noise, strict=True):
        routed, state = prior.start(scene, prior.choose_routes(scene, uniform))
        zero = torch.zeros(batch, dtype=torch.long, device=seed.device)
        context = prior.encode(routed, state, scene["start"], scene["valid"], zero, None)
        plans.append(prior.decode(prior.sample(context, one).x0, context).states())
    return torch.stack(plans, 1)


def _straight_plan(synthesizer: Baseline, scene: TensorDictBase, seed: Tensor) -> Tensor:
    """The plan [B, V, HORIZON, 4] of a baseline; seed [B]."""
    zero = torch.zeros_like(seed)
    episode = synthesizer.begin(scene, seed, zero.float())
    world = World(scene, zero, scene["start"], scene["valid"], scene["start_accel"], episode.routed.route)
    unknown = scene["start"][:, :1].expand(-1, HORIZON, -1)  # baselines do not look at the ego's plan
    return synthesizer.replan(episode, world, unknown)[1].states()


def _displacements(scene: TensorDictBase, plans: Tensor) -> dict[str, Tensor]:
    """The columns of `scene_displacements` of simulated vehicles for plans [B, S, V, HORIZON, 4]."""
    vehicles = plans.shape[2]
    here = scene["valid"][:, :vehicles] & (scene["agent_type"][:, :vehicles] == VEHICLE)
    times = torch.arange(1, HORIZON + 1, device=plans.device)[None]
    straight = straight_on(scene["start"][:, :vehicles], times)
    logged, valid = scene["logged"][:, :, :vehicles], scene["logged_valid"][:, :, :vehicles]
    columns = scene_displacements(plans, straight, logged, valid, here, HORIZONS)
    return {name: value.cpu().double() for name, value in columns.items()}


def _summary(columns: dict[str, Tensor], scenes: SceneSet) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high, n}}: quotients of sums over scenes, places resampled; n counts vehicles."""
    rows = [{"location": place, "scene_id": name} for place, name in zip(scenes.location, scenes.scene_id, strict=True)]
    cluster, clusters = cluster_index(rows)
    draws = bootstrap_draws(clusters)
    result = {}
    for at in (f"_{horizon:g}" for horizon in HORIZONS):
        vehicles, straight = columns[f"vehicles{at}"], columns[f"cv_ade{at}"]
        quotients = {
            f"{name}{at}": (columns[name + at], vehicles) for name in ("min_ade", "mean_ade", "joint_ade", "cv_ade")
        }
        quotients |= {f"{name}_ratio{at}": (columns[name + at], straight) for name in ("min_ade", "mean_ade")}
        totals, weights = (torch.stack(column, -1) for column in zip(*quotients.values(), strict=True))
        means = resampled_means(totals, weights, cluster, draws)
        places = len(cluster[vehicles > 0].unique())
        result |= {name: interval(means[:, k], places) | {"n": int(vehicles.sum())} for k, name in enumerate(quotients)}
    return result
