"""Contacts, distances, progress and the road, scored anew from rollout files with numpy
and shapely alone."""

import numpy as np
import pytest
import torch

import e2rl
from e2rl.metrics.score import score_rollouts
from e2rl.planners.ego import PLAN_STEPS, Ego
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import constant_velocity
from e2rl.traffic.rule_based import ConstantVelocity, LogReplay
from tests.metrics.random_rollouts import random_rollouts

shapely = pytest.importorskip("shapely")


class Blind(Ego):
    """Goes straight on, whoever is there."""

    def plan(self, world):
        return constant_velocity(
            world.states[:, 0], DT * torch.arange(1, PLAN_STEPS + 1)
        )


def bundled(traffic):
    return e2rl.roll_out(
        e2rl.load_scenes("bundled", num_scenes=6), Blind(), traffic=traffic
    )


SETS = {
    "drawn": lambda: random_rollouts(12, seed=4, vehicles=14, others=6, extent=40.0),
    "bundled, replayed": lambda: bundled(LogReplay()),
    "bundled, straight on": lambda: bundled(ConstantVelocity()),
}


def boxes(states, size):
    """Polygons [...] of boxes size [..., 2] at states [..., 4]; empty ones where the
    states are none."""
    ahead = (
        np.stack([np.cos(states[..., 2]), np.sin(states[..., 2])], -1)
        * size[..., :1]
        / 2
    )
    left = (
        np.stack([-np.sin(states[..., 2]), np.cos(states[..., 2])], -1)
        * size[..., 1:]
        / 2
    )
    middle = states[..., :2]
    corners = [
        middle + ahead + left,
        middle + ahead - left,
        middle - ahead - left,
        middle - ahead + left,
    ]
    return shapely.polygons(np.nan_to_num(np.stack(corners, -2)))


def on_road(points, file):
    """Bool [n]: points [n, 2] in a drivable polygon, or at most 1 m beside a lane."""
    tree = shapely.STRtree(shapely.points(points))
    result = np.zeros(len(points), bool)

    def lines(name):
        parts = zip(
            file[f"{name}_offsets"][:-1], file[f"{name}_offsets"][1:], strict=True
        )
        return [file[f"{name}_points"][begin:end].astype(float) for begin, end in parts]

    for line, width in zip(lines("lane"), file["lane_width"], strict=False):
        if len(line) > 1:
            result[
                tree.query(shapely.linestrings(line), "dwithin", width / 2 + 1.0)
            ] = True
    for ring in lines("drivable"):
        if len(ring) > 2:
            result[tree.query(shapely.polygons(ring), "contains")] = True
    return result


def score(file):
    """What a rollout file's contacts, distances, progress and road are."""
    place = file["valid"]
    simulated = np.flatnonzero(file["simulated"])
    states = np.where(place[..., None], file["states"], 0).astype(float)
    box = boxes(states, np.broadcast_to(file["size"].astype(float), (*place.shape, 2)))
    vehicle = file["agent_type"] == "vehicle"
    area = shapely.area(shapely.intersection(box[:, :1], box)) * place * place[:, :1]
    area[:, 0] = 0
    hits = ((area * vehicle) > 0).any(1)
    unknown = hits[0]
    after = np.flatnonzero(hits[1:]) + 1
    hit = bool(len(after)) and not unknown
    stop = after[0] if hit else len(hits) - 1
    observed = place[1 : stop + 1] & place[1 : stop + 1, :1]
    gap = np.where(
        observed, shapely.distance(box[1 : stop + 1, :1], box[1 : stop + 1]), np.inf
    )[:, 1:]
    ego = states[: stop + 1, 0][place[: stop + 1, 0]]
    turn = np.diff(ego[:, 2])
    heading = ego[:-1, 2] + np.arctan2(np.sin(turn), np.cos(turn)) / 2
    result = {
        "cfr": np.nan if unknown else float(hit),
        "cfr_vru": float(
            (
                (area * np.isin(file["agent_type"], ("pedestrian", "cyclist")))[
                    1 : stop + 1
                ]
                > 0
            ).any()
        ),
        "cfr_object": float(
            ((area * (file["agent_type"] == "other"))[1 : stop + 1] > 0).any()
        ),
        "contact_step": float(stop) if hit else np.nan,
        "partner": float((area * vehicle)[stop].argmax()) if hit else -1.0,
        "min_dtc": 0.0 if hit else gap.min() if np.isfinite(gap).any() else np.nan,
        "progress": (
            np.diff(ego[:, 0]) * np.cos(heading) + np.diff(ego[:, 1]) * np.sin(heading)
        ).sum(),
        "bg_pairs": 0.0,
    }
    others = simulated[simulated > 0]
    for number, first in enumerate(others):
        two = others[number + 1 :]
        both = place[: stop + 1, [first]] & place[: stop + 1, two]
        meet = (
            shapely.area(
                shapely.intersection(box[: stop + 1, [first]], box[: stop + 1, two])
            )
            > 0
        ) & both
        result["bg_pairs"] += (meet[1:].any(0) & ~meet[0]).sum()
    road = on_road(states[: stop + 1, :, :2].reshape(-1, 2), file).reshape(stop + 1, -1)
    counted = place[: stop + 1, others] & place[0, others] & road[0, others]
    off = counted[1:] & ~road[1:][:, others]
    mapped = len(file["lane_points"]) + len(file["drivable_points"]) > 0
    certain = mapped and counted[1:].any()
    result["aor_vehicle_steps"] = float(counted[1:].sum()) * mapped
    result["aor_step"] = off.sum() / counted[1:].sum() if certain else np.nan
    left = (place[: stop + 1, 0] & ~road[:, 0]).any()
    result["ego_off_road"] = float(left) if mapped and road[0, 0] else np.nan
    return result


@pytest.mark.parametrize("name", SETS)
def test_rows_are_what_another_reader_of_the_files_scores(name, tmp_path):
    rollouts = SETS[name]()
    files = [np.load(path) for path in rollouts.to_npz(tmp_path)]
    theirs = {(str(file["scene_id"]), int(file["seed"])): score(file) for file in files}
    rows = score_rollouts(rollouts)[0]
    assert len(theirs) == len(rows)
    assert {row["cfr"] for row in rows} >= {0.0, 1.0}
    for row in rows:
        other = theirs[row["scene_id"], row["seed"]]
        assert {key: float(row[key]) for key in other} == pytest.approx(
            other, abs=1e-6, nan_ok=True
        ), row["scene_id"]
