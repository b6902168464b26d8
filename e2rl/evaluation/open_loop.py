"""Open-loop accuracy of traffic methods: plans from causal start states, without the ego's plan, against the log."""

from collections.abc import Sequence
from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.evaluation.kept import NOTHING_KEPT, Kept
from e2rl.evaluation.protocol import SEEDS_APART, Method
from e2rl.evaluation.summary import metric_row
from e2rl.metrics.catalogue import OPEN_LOOP_STAGE
from e2rl.metrics.displacement import scene_displacements
from e2rl.metrics.statistics import bootstrap_draws, cluster_index, interval, resampled_means
from e2rl.scene.recording import VEHICLE
from e2rl.scene.scene import SceneSet
from e2rl.traffic.traffic import keep_velocity

HORIZONS = (3.0, 5.0)  # s
EGO = "unknown"  # `ego` column of the rows: no method receives the ego's plan
BATCH = 32  # scenes planned at once


@torch.no_grad()
def open_loop_rows(
    scenes: SceneSet, methods: Sequence[Method], samples: int, device: str = "cpu", kept: Kept = NOTHING_KEPT
) -> list[dict]:
    """Rows of metrics.json, stage `open loop`, of every uncontrolled method that predicts: minADE, mean and joint ADE
    over `samples` and their ratios to constant velocity's ADE on the same vehicles, with intervals over places.

    kept: methods that are finished.
    """
    rows = []
    for number, method in enumerate(methods):
        if method.eta > 0 or not method.traffic.predicts:
            continue
        count = samples if method.traffic.stochastic else 1
        compute = partial(open_loop_metrics, scenes, method, count, device)
        metrics = kept.result(f"open-loop-{number:03}", [method.name, count], compute)
        key = (scenes.dataset, scenes.split, method.name, EGO, method.eta)
        rows.append(metric_row(key, len(scenes), count, len(scenes) * count, metrics, stage=OPEN_LOOP_STAGE))
    return rows


def open_loop_metrics(scenes: SceneSet, method: Method, count: int, device: str) -> dict[str, dict[str, float]]:
    """The metrics of `count` open-loop samples of every scene."""
    parts = []
    for index in torch.arange(len(scenes)).split(BATCH):
        scene = scenes.batch(index).to(device)
        seed = index.to(device) + SEEDS_APART * torch.arange(count, device=device)[:, None]
        parts.append(_displacements(scene, method.traffic.open_loop_plans(scene, seed)))
    return _summary({name: torch.cat([part[name] for part in parts]) for name in parts[0]}, scenes)


def _displacements(scene: TensorDictBase, plans: Tensor) -> dict[str, Tensor]:
    """The columns of `scene_displacements` of simulated vehicles for plans [B, S, V, HORIZON, 4]."""
    vehicles = plans.shape[2]
    here = scene["valid"][:, :vehicles] & (scene["agent_type"][:, :vehicles] == VEHICLE)
    straight = keep_velocity(scene["start"][:, :vehicles])
    logged, valid = scene["logged"][:, :, :vehicles], scene["logged_valid"][:, :, :vehicles]
    columns = scene_displacements(plans, straight, logged, valid, here, HORIZONS)
    return {name: value.cpu().double() for name, value in columns.items()}


def _summary(columns: dict[str, Tensor], scenes: SceneSet) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high, n}}: ratios of sums over scenes, places resampled; n counts vehicles."""
    rows = [{"location": place, "scene_id": name} for place, name in zip(scenes.location, scenes.scene_id, strict=True)]
    cluster, clusters = cluster_index(rows)
    draws = bootstrap_draws(clusters)
    result: dict[str, dict[str, float]] = {}
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
