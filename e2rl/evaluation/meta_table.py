"""The realism meta-metric of traffic models over many rollouts per scene, and the log's
own split-half `real`.

Histograms are sums over rollouts, so batches are counted one by one and memory stays
constant.
"""

from collections import Counter
from collections.abc import Sequence
from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor

from e2rl.evaluation.protocol import Method, Setup, Task
from e2rl.evaluation.summary import metric_row
from e2rl.metrics.catalogue import META_STAGE
from e2rl.metrics.meta_metric import (
    FEATURES,
    HISTOGRAMS,
    INDICATIONS,
    bin_counts,
    bin_index,
    likelihood,
    log_bernoulli,
    log_probability,
    meta_metric,
    track_features,
)
from e2rl.metrics.realism import kinematic_samples, split_half
from e2rl.metrics.statistics import (
    LEVELS,
    bootstrap_draws,
    cluster_index,
    interval,
    resampled_means,
)
from e2rl.prior.routes import take_route
from e2rl.run.parts import NO_PARTS, Parts
from e2rl.run.terminal import Bar
from e2rl.scenes.recording import VEHICLE
from e2rl.scenes.scene import SceneSet
from e2rl.sim.rollouts import Rollouts
from e2rl.traffic.attempt import attempt

TRACKS = 512  # vehicles of rollouts processed at once: bounds the memory of the pairwise features
SPLITS = 200  # random splits of the logs into halves


class Tally:
    """Counts of the features' bins and of indications for every vehicle [S * V] of
    scenes [S], over rollouts."""

    def __init__(self, scenes: SceneSet, state: tuple | None = None):
        """state: of a Tally to go on from."""
        self.scenes = scenes
        self.vehicles = scenes.scenes["route_log"].shape[1]
        none = torch.zeros(len(scenes) * self.vehicles, dtype=torch.float64)
        counts = {
            name: none.new_zeros(len(none), FEATURES[name].bins) for name in HISTOGRAMS
        }
        self.state = state or (
            none.clone(),
            counts,
            {name: none.clone() for name in INDICATIONS},
        )
        self.rollouts, self.counts, self.hits = self.state

    def add(self, index: Tensor, rollouts: Rollouts, weight: int = 1) -> None:
        """Count rollouts of scenes index [B] int64, each as `weight` equal ones."""
        scenes = self.scenes.batch(index)
        tracks = {
            "states": rollouts.states,
            "valid": rollouts.valid,
            "size": rollouts.size,
        }
        assert rollouts.routes is not None
        batch = {**tracks, **roads_of(scenes, rollouts.routes)}
        every = index[:, None] * self.vehicles + torch.arange(self.vehicles)
        self.rollouts.index_add_(
            0,
            every.flatten(),
            torch.full((every.numel(),), float(weight), dtype=torch.float64),
        )
        rollout, agent = evaluated(scenes).nonzero(as_tuple=True)
        for part in torch.arange(len(rollout)).split(TRACKS):
            key = index[rollout[part]] * self.vehicles + agent[part]
            values, events = track_features(batch, rollout[part], agent=agent[part])
            for name, (value, known) in values.items():
                bins = bin_counts(
                    bin_index(value, FEATURES[name]), known, bins=FEATURES[name].bins
                )
                self.counts[name].index_add_(0, key, bins, alpha=weight)
            for name, event in events.items():
                self.hits[name].index_add_(0, key, event.double(), alpha=weight)

    def likelihoods(self) -> dict[str, Tensor]:
        """Likelihood [S] of each feature's logged values after the rollouts counted;
        NaN for a scene without any."""
        found: dict[str, list[tuple[Tensor, Tensor, Tensor]]] = {
            name: [] for name in FEATURES
        }
        driven = self.rollouts.view(len(self.scenes), self.vehicles) > 0
        begin = 0  # of the part
        for scenes in self.scenes.parts():
            log = {
                "states": scenes["logged"],
                "valid": scenes["logged_valid"],
                "size": scenes["size"],
            }
            batch = {**log, **roads_of(scenes, scenes["route_log"])}
            row, agent = (
                evaluated(scenes) & driven[begin : begin + len(scenes)]
            ).nonzero(as_tuple=True)
            for part in torch.arange(len(row)).split(TRACKS):
                scene = begin + row[part]
                key = scene * self.vehicles + agent[part]
                values, events = track_features(batch, row[part], agent=agent[part])
                for name, (value, known) in values.items():
                    log_p = log_probability(
                        self.counts[name][key], bin_index(value, FEATURES[name])
                    )
                    found[name].append((log_p, known, scene))
                for name, event in events.items():
                    log_p = log_bernoulli(
                        self.hits[name][key], self.rollouts[key], happened=event
                    )[:, None]
                    found[name].append(
                        (log_p, torch.ones_like(log_p, dtype=torch.bool), scene)
                    )
            begin += len(scenes)
        result = {}
        for name, parts in found.items():
            log_p, known, scene = map(torch.cat, zip(*parts, strict=True))
            result[name] = likelihood(
                log_p, known, scene=scene, scenes=len(self.scenes)
            )
        return result


def evaluated(scene: TensorDictBase) -> Tensor:
    """Bool [B, V]: vehicles other than the ego that are present at the start and
    recorded throughout."""
    vehicles = scene["route_log"].shape[1]
    chosen = (
        scene["valid"] & scene["logged_valid"].all(1) & (scene["agent_type"] == VEHICLE)
    )
    return torch.cat([torch.zeros_like(chosen[:, :1]), chosen[:, 1:vehicles]], 1)


def roads_of(scene: TensorDictBase, route: Tensor) -> dict[str, Tensor]:
    """Road, lights and routes of scenes [B] whose vehicles follow candidates route [B,
    V] (-1: no route, no lights)."""
    chosen = route.clamp(min=0)
    light = take_route(scene["route_light"], chosen)
    return {
        "field": scene["field"],
        "field_origin": scene["field_origin"],
        "light_state": scene["light_state"],
        "route_points": take_route(scene["route_points"], chosen),
        "route_light": torch.where((route >= 0)[..., None], light, -1),
        "route_light_s": take_route(scene["route_light_s"], chosen),
    }


def meta_rows(
    setup: Setup, methods: Sequence[Method], rollouts: int, parts: Parts = NO_PARTS
) -> list[dict]:
    """Rows of metrics.json, stage `meta-metric`: every feature's likelihood and their
    weighted sum.

    They are over `rollouts` rollouts of each scene, with intervals over places; a
    deterministic method is rolled out once. The row of the log also has its split-half
    `real`. Rollouts that error are counted in `errored`, and in no likelihood. parts:
    the counts of each method so far.
    """
    scenes = setup.scenes
    rows = []
    seeds = [rollouts if method.traffic.stochastic else 1 for method in methods]
    with Bar(total=sum(seeds) * len(scenes), desc="meta-metric", unit="rollout") as bar:
        for number, (method, count) in enumerate(zip(methods, seeds, strict=True)):
            name = f"meta-{number:03}"
            identity = [method.name, float(method.eta), rollouts, "with errored"]
            done, errored, state = parts.load(name, identity) or (0, [], None)
            tally = Tally(scenes, state)
            tasks = [
                Task(scene, seed)
                for seed in range(count)
                for scene in range(len(scenes))
            ]
            bar.update(done)
            for begin in range(done, len(tasks), setup.batch):
                batch = tasks[begin : begin + setup.batch]
                driven, others = attempt(
                    partial(setup.roll_out, method), batch, begins=begin == 0
                )
                for pairs, rolled_out in driven:
                    tally.add(
                        torch.tensor([task.scene for task in pairs]),
                        rolled_out,
                        rollouts // count,
                    )
                errored += [why["reason"] for _, why in others]
                parts.save(name, identity, (begin + len(batch), errored, tally.state))
                bar.update(len(batch))
            metrics = summarise_meta(tally.likelihoods(), scenes)
            if method.traffic.replays_log:
                metrics["real_split_half"] = log_split_half(scenes)
            key = (
                scenes.dataset,
                scenes.split,
                method.name,
                setup.ego_name,
                method.eta,
            )
            fields = {"stage": META_STAGE, "errored": dict(Counter(errored))}
            rolled = rollouts * len(scenes) - len(errored) * (rollouts // count)
            rows.append(
                metric_row(
                    key,
                    len(scenes),
                    seeds=rollouts,
                    rollouts=rolled,
                    metrics=metrics,
                    **fields,
                )
            )
    return rows


def summarise_meta(
    likelihoods: dict[str, Tensor], scenes: SceneSet
) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high, n}} of likelihoods [S] per scene; n counts the scenes
    with an evaluated vehicle."""
    cluster, clusters = cluster_index(scenes.location, scenes.scene_id)
    table = torch.stack([meta_metric(likelihoods), *likelihoods.values()], -1)
    means = resampled_means(
        table, torch.ones_like(table), cluster=cluster, draws=bootstrap_draws(clusters)
    )
    known = ~table.isnan()
    return {
        name: interval(means[:, k], len(cluster[known[:, k]].unique()))
        | {"n": int(known[:, k].sum())}
        for k, name in enumerate(("meta_metric", *likelihoods))
    }


def log_split_half(scenes: SceneSet) -> dict[str, float]:
    """Mean and 95% range of `real` between random halves of the logs, split by place; n
    counts scenes."""
    samples = []
    for scene in scenes.parts():
        simulated = scene["valid"] & (scene["agent_type"] == VEHICLE)
        simulated[:, 0] = False
        simulated[:, scene["route_log"].shape[1] :] = False
        log = scene["logged"].double(), scene["logged_valid"]
        samples += kinematic_samples(
            *log, *log, simulated, torch.full((len(scene),), scenes.steps)
        )
    cluster, clusters = cluster_index(scenes.location, scenes.scene_id)
    generator = torch.Generator().manual_seed(0)
    order = torch.rand(SPLITS, clusters, generator=generator).argsort(1)
    values = split_half(samples, cluster, halves=order < clusters // 2)
    low, high = values.nanquantile(values.new_tensor(LEVELS)).tolist()
    return {"mean": values.nanmean().item(), "low": low, "high": high, "n": len(scenes)}
