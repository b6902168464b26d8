"""Open-loop tables: plans of traffic methods from causal start states, without the
ego's plan, against the log; and the spread of the prior's samples beside that of MANY
steps: what few network evaluations lose of it."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from e2rl.evaluation.protocol import SEEDS_APART, Method
from e2rl.evaluation.rollout_files import require_rows
from e2rl.evaluation.summary import metric_row
from e2rl.metrics.catalogue import OPEN_LOOP_STAGE, SPREAD_STAGE, STAGES, Metric
from e2rl.metrics.displacement import HORIZONS, scene_displacements
from e2rl.metrics.statistics import (
    bootstrap_draws,
    cluster_index,
    interval,
    resampled_means,
)
from e2rl.prior.prior import Prior
from e2rl.prior.spread import sample_variances
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.scenes.recording import VEHICLE
from e2rl.scenes.scene import SceneSet
from e2rl.traffic.attempt import attempt, count_reasons
from e2rl.traffic.nominal import NominalTraffic
from e2rl.traffic.traffic import keep_velocity

EGO = "unknown"  # `ego` column of the rows: no method receives the ego's plan
BATCH = 32  # scenes planned at once
MANY = 200  # steps of the reverse SDE that stand for the trained distribution
STAGES[SPREAD_STAGE] = (
    Metric("knot_variance", "variance over samples of an acceleration knot"),
    Metric("lateral_variance", "variance over samples of a lateral knot"),
    Metric(
        "travel_std", "standard deviation over samples of the way after 5 s", unit="m"
    ),
    *(
        Metric(f"{name}_ratio", f"{name} over that of {MANY} steps")
        for name in ("knot_variance", "lateral_variance", "travel_std")
    ),
    Metric(
        "covered_50",
        "recorded ways after 5 s in the central half of the samples'",
        fraction=True,
    ),
    Metric(
        "covered_90",
        "recorded ways after 5 s in the central nine tenths of the samples'",
        fraction=True,
    ),
)


@torch.no_grad()
def open_loop_rows(
    scenes: SceneSet,
    methods: Sequence[Method],
    samples: int,
    device: str = "cpu",
    parts: Parts = NO_PARTS,
) -> list[dict]:
    """Rows of metrics.json, stage `open loop`, of every uncontrolled method that
    predicts.

    They hold minADE, mean and joint ADE over `samples` plans of each scene, and their
    ratios to constant velocity's ADE on the same vehicles, with intervals over places.
    parts: the methods that are done.
    """
    rows = []
    for number, method in enumerate(methods):
        if method.eta > 0 or not method.traffic.predicts:
            continue
        count = samples if method.traffic.stochastic else 1
        compute = partial(open_loop_metrics, scenes, method, count, device)
        found = parts.result(
            f"open-loop-{number:03}", [method.name, count, "with errored"], compute
        )
        done = found["scenes"]
        key = (scenes.dataset, scenes.split, method.name, EGO, method.eta)
        fields = {"stage": OPEN_LOOP_STAGE, "errored": found["errored"]}
        rows.append(
            metric_row(
                key,
                done,
                seeds=count,
                rollouts=done * count,
                metrics=found["metrics"],
                **fields,
            )
        )
    return rows


def open_loop_metrics(
    scenes: SceneSet, method: Method, count: int, device: str
) -> dict[str, Any]:
    """`metrics` of `count` open-loop samples of every scene, the number of `scenes`
    that they are of, and `errored`: how many others errored, for each reason. Raises
    InputError where all errored."""

    def plan(tasks: Sequence[int]) -> TensorDict:
        index = torch.tensor(tasks)
        scene = scenes.batch(index).to(device)
        seed = (
            index.to(device) + SEEDS_APART * torch.arange(count, device=device)[:, None]
        )
        plans = method.traffic.open_loop_plans(scene, seed)
        vehicles = plans.shape[2]
        here = scene["valid"][:, :vehicles] & (
            scene["agent_type"][:, :vehicles] == VEHICLE
        )
        log = scene["logged"][:, :, :vehicles], scene["logged_valid"][:, :, :vehicles]
        columns = scene_displacements(
            plans, keep_velocity(scene["start"][:, :vehicles]), *log, here
        )
        found = {
            "states": plans,
            "valid": here[:, None, :, None].expand(plans.shape[:-1]),
        }
        return TensorDict(
            found | {name: value.double() for name, value in columns.items()},
            [len(tasks)],
        ).cpu()

    planned: list[Any] = []
    errored: list[dict] = []
    for batch in torch.arange(len(scenes)).split(BATCH):
        found, others = attempt(plan, batch.tolist())
        planned += found
        errored += [why for _, why in others]
    require_rows(planned, errored, folder=None)
    done = [scene for tasks, _ in planned for scene in tasks]
    columns = torch.cat([part.exclude("states", "valid") for _, part in planned])
    return {
        "metrics": _displacements(columns, scenes, done=done),
        "scenes": len(done),
        "errored": count_reasons(errored),
    }


def _displacements(
    columns: TensorDict, scenes: SceneSet, done: Sequence[int]
) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high, n}}: ratios of sums over the scenes `done`, places
    resampled; n counts vehicles."""
    cluster, clusters = cluster_index(
        *([names[k] for k in done] for names in (scenes.location, scenes.scene_id))
    )
    draws = bootstrap_draws(clusters)
    result: dict[str, dict[str, float]] = {}
    for at in (f"_{horizon}" for horizon in HORIZONS):
        vehicles = columns[f"vehicles{at}"]
        straight = columns[f"cv_ade{at}"]
        quotients = {
            f"{name}{at}": (columns[name + at], vehicles)
            for name in ("min_ade", "mean_ade", "joint_ade", "cv_ade")
        }
        quotients |= {
            f"{name}_ratio{at}": (columns[name + at], straight)
            for name in ("min_ade", "mean_ade")
        }
        totals, weights = (
            torch.stack(column, -1) for column in zip(*quotients.values(), strict=True)
        )
        means = resampled_means(totals, weights, cluster=cluster, draws=draws)
        places = len(cluster[vehicles > 0].unique())
        result |= {
            name: interval(means[:, k], places) | {"n": int(vehicles.sum())}
            for k, name in enumerate(quotients)
        }
    return result


# --- spread


def spread_rows(
    scenes: SceneSet,
    methods: Sequence[Method],
    samples: int,
    device: str = "cpu",
    parts: Parts = NO_PARTS,
) -> list[dict]:
    """Rows of metrics.json, stage `spread`, of every method that is the prior alone;
    intervals over places.

    samples: of each scene. parts: the methods that are done.
    """
    rows = []
    for method in methods:
        if (
            method.eta > 0
            or not isinstance(method.traffic, NominalTraffic)
            or method.traffic.adversarial
        ):
            continue
        prior = method.traffic.prior
        many = copy.copy(prior)
        many.sampler = replace(prior.sampler, steps=MANY)
        few_sums, many_sums = (
            parts.result(
                f"spread-{method.name}-{each.sampler.steps:03}",
                [method.name, samples, each.sampler.steps],
                partial(_sums, each, scenes, samples, device),
            )
            for each in (prior, many)
        )
        key = (scenes.dataset, scenes.split, method.name, EGO, method.eta)
        count = len(scenes)
        metrics = _spread(few_sums, many_sums, scenes=scenes)
        rows.append(
            metric_row(
                key,
                count,
                seeds=samples,
                rollouts=count * samples,
                metrics=metrics,
                stage=SPREAD_STAGE,
            )
        )
    return rows


def _sums(prior: Prior, scenes: SceneSet, samples: int, device: str) -> Tensor:
    """Sums [R, 7] of each scene: see `sample_variances`."""
    found = [
        torch.stack(
            list(
                sample_variances(
                    prior, scenes.batch(rows).to(device), samples=samples
                ).values()
            ),
            -1,
        ).cpu()
        for rows in torch.arange(len(scenes)).split(BATCH)
    ]
    return torch.cat(found)


def _spread(few: Tensor, many: Tensor, scenes: SceneSet) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high, n}}; n counts vehicles."""
    cluster, clusters = cluster_index(scenes.location, scenes.scene_id)
    draws = bootstrap_draws(clusters)
    vehicles = few[:, 3:4].expand(-1, 3)
    of_few, of_many = (
        resampled_means(sums[:, :3], vehicles, cluster=cluster, draws=draws)
        for sums in (few, many)
    )
    for means in (of_few, of_many):
        means[:, 2] = means[:, 2].sqrt()
    places = len(cluster[few[:, 3] > 0].unique())
    names = [metric.name for metric in STAGES[SPREAD_STAGE]]
    covered = resampled_means(
        few[:, 4:6], few[:, 6:].expand(-1, 2), cluster=cluster, draws=draws
    )
    columns = torch.cat([of_few, of_few / of_many, covered], 1)
    counts = [*[int(few[:, 3].sum())] * 6, *[int(few[:, 6].sum())] * 2]
    return {
        name: interval(columns[:, k], places) | {"n": counts[k]}
        for k, name in enumerate(names)
    }
