"""Time to collision against stepped polygons; cliques, scores, candidates against the
definitions in plain Python."""

import math
from itertools import combinations

import numpy as np
import pytest
import shapely
import torch

from e2rl.scenes.boxes import corners
from e2rl.traffic.e2 import topology
from e2rl.traffic.e2.topology import (
    HOPS,
    RISK_SECONDS,
    STRIDE,
    TopologySettings,
    pair_weights,
    time_to_collision,
    topological_candidates,
)


def random_boxes(count, n, spread, seed):
    generator = torch.Generator().manual_seed(seed)
    states = torch.rand(count, n, 4, generator=generator, dtype=torch.float64)
    states = (states - torch.tensor([0.5, 0.5, 0.5, 0.0])) * torch.tensor(
        [2 * spread, 2 * spread, 6.28, 15.0]
    )
    size = 1.5 + 4 * torch.rand(count, n, 2, generator=generator, dtype=torch.float64)
    return states, size


def rollout(states, steps=81):
    """Constant velocity [B, T, V, 4] from states [B, V, 4]."""
    time = 0.1 * torch.arange(steps)[:, None]
    track = states[:, None].repeat(1, steps, 1, 1)
    track[..., 0] += time * (states[..., 3] * states[..., 2].cos())[:, None]
    track[..., 1] += time * (states[..., 3] * states[..., 2].sin())[:, None]
    return track


def test_first_contact_is_that_of_stepped_polygons():
    states, size = random_boxes(120, 2, spread=15.0, seed=0)
    closed = time_to_collision(states, size)
    assert torch.equal(closed, closed.transpose(-1, -2))
    time = torch.arange(0, 8.0, 0.01, dtype=torch.float64)
    velocity = states[..., 3:] * torch.stack(
        [states[..., 2].cos(), states[..., 2].sin()], -1
    )
    kinds = []
    for pair in range(len(states)):

        def at(t, pair=pair):
            moved = states[pair, :, None].repeat(1, len(t), 1)
            moved[..., :2] += t[:, None] * velocity[pair, :, None]
            return shapely.polygons(corners(moved, size[pair, :, None]).numpy())

        hit = shapely.intersects(*at(time))
        ttc = closed[pair, 0, 1]
        kinds.append("now" if hit[0] else "later" if hit.any() else "never")
        if hit.any():
            assert abs(ttc - time[np.argmax(hit)]) <= 0.0101
        elif (
            ttc.isfinite()
        ):  # shorter than a step: the outlines must touch at that moment
            assert shapely.distance(*at(ttc[None]))[0] < 1e-9
    assert set(kinds) == {"now", "later", "never"}


@pytest.mark.parametrize(("gap", "ttc"), [(79.9, 7.99), (80.1, math.inf)])
def test_ttc_of_a_follower_of_equal_speeds_and_at_the_horizon(gap, ttc):
    states = torch.tensor([[0.0, 0, 0, 10], [4 + gap, 0, 0, 0], [-30, 0, 0, 10]])
    result = time_to_collision(states, torch.tensor([4.0, 2.0]).expand(3, 2))
    assert RISK_SECONDS == 8.0
    assert result[0, 1].item() == pytest.approx(ttc)
    assert result[0, 2] == torch.inf
    assert result[0, 0] == 0


def test_weights_are_the_sigmoid_of_the_ttc_and_nothing_for_the_absent():
    """Boxes grown by the clearance: a gap of 34 - 4 - 1 m closes at 10 m/s."""
    settings = TopologySettings(clearance=1.0, tau_max=2.5, beta=0.5)
    states = torch.tensor([[0.0, 0, 0, 10], [34, 0, 0, 0], [30, 0, 0, 0]])
    weight = pair_weights(
        states,
        torch.tensor([True, True, False]),
        size=torch.tensor([4.0, 2.0]).expand(3, 2),
        settings=settings,
    )
    assert weight[0, 1].item() == pytest.approx(1 / (1 + math.exp((2.9 - 2.5) / 0.5)))
    assert weight[1, 0] == weight[0, 1]
    assert weight[2].sum() == 0
    assert weight.diagonal().sum() == 0


def cliques_by_definition(weight, distance, valid, settings):
    """The top cliques of one graph, by Sec. IV-A1: brute force over all subsets."""
    present = sorted(
        (i for i in range(len(weight)) if valid[i]), key=lambda i: (distance[i], i)
    )[: topology.NODES]
    edges = {
        (i, j)
        for i in present
        for j in present
        if i != j and weight[i, j] >= settings.edge_threshold
    }
    hops = {0: 0}
    for hop in range(1, HOPS + 2):
        hops |= {
            j: hop
            for i, j in edges
            if i in hops and j not in hops and hops[i] == hop - 1
        }
    graph = {(i, j) for i, j in edges if i in hops and j in hops}
    nodes = sorted({i for i, _ in graph})
    complete = [
        set(some)
        for size in range(2, len(nodes) + 1)
        for some in combinations(nodes, size)
        if all((i, j) in graph for i, j in combinations(some, 2))
    ]
    result = set()
    for clique in (
        some for some in complete if not any(some < other for other in complete)
    ):
        total = {
            i: round(math.fsum(weight[i, j] for j in clique if j != i), 6)
            for i in clique
        }
        order = sorted(clique, key=lambda i: (i != 0, -total[i], distance[i], i))
        result.add(tuple(sorted(order[: settings.max_clique])))
    result = [clique for clique in result if min(hops[i] for i in clique) <= HOPS]

    def rank(clique):
        pairs = [weight[i, j] for i, j in combinations(clique, 2)]
        return (
            -round(math.fsum(pairs) / len(pairs), 6),
            math.fsum(distance[i] for i in clique) / len(clique),
            clique,
        )

    return sorted(result, key=rank)[: settings.top_cliques]


@pytest.mark.parametrize(("seed", "nodes"), [(3, 24), (5, 24), (8, 24), (9, 7)])
def test_scores_and_candidates_are_those_of_the_definition(seed, nodes, monkeypatch):
    """Eqs. (ttc_weight_t) and (temporal_scoring): a point for each top clique of each
    analysed step."""
    monkeypatch.setattr(topology, "NODES", nodes)
    states, size = random_boxes(1, 11, spread=20.0, seed=seed)
    states[:, 0, :2] *= 0.3
    track = rollout(states)
    valid = torch.rand(1, 81, 11, generator=torch.Generator().manual_seed(seed)) < 0.9
    valid[:, :, 0] = valid[:, 0] = True
    settings = TopologySettings(candidates=3, max_clique=3, top_cliques=2)
    result = topological_candidates(track, valid, size=size, settings=settings)
    assert result.steps.tolist() == list(range(0, 81, STRIDE))
    assert STRIDE == 5
    score = [0] * 11
    nearest = [math.inf] * 11
    for number, step in enumerate(result.steps.tolist()):
        distance = (track[0, step, :, :2] - track[0, step, :1, :2]).norm(dim=-1)
        distance = distance.masked_fill(~valid[0, step], math.inf).tolist()
        nearest = [min(pair) for pair in zip(nearest, distance, strict=True)]
        weight = result.weights[0, number].numpy()
        expected = cliques_by_definition(
            weight, distance, valid=valid[0, step].tolist(), settings=settings
        )
        assert result.cliques[0][number] == expected
        for i in (i for clique in expected for i in clique):
            score[i] += 1
    assert result.score[0].tolist() == score
    order = sorted(
        (i for i in range(1, 11) if score[i] > 0),
        key=lambda i: (-score[i], nearest[i], i),
    )
    assert len(order) > 3
    assert result.candidates[0].nonzero()[:, 0].tolist() == sorted(order[:3])


def candidates_of(pairs, vehicles, monkeypatch, **settings):
    """Candidates where just these pairs are at risk, of vehicles 10 m apart in a row
    from the ego on."""
    weight = torch.zeros(vehicles, vehicles)
    for i, j in pairs:
        weight[i, j] = weight[j, i] = 0.9
    monkeypatch.setattr(
        topology, "pair_weights", lambda states, *_, **__: weight.expand(1, 1, -1, -1)
    )
    states = torch.zeros(1, 1, vehicles, 4)
    states[..., 0] = 10.0 * torch.arange(vehicles)
    result = topological_candidates(
        states,
        torch.ones(1, 1, vehicles, dtype=torch.bool),
        size=torch.tensor([4.0, 2.0]).expand(1, vehicles, 2),
        settings=TopologySettings(**settings),
    )
    return result.candidates[0].nonzero()[:, 0].tolist()


def test_a_queue_counts_up_to_three_vehicles_from_the_ego(monkeypatch):
    """Cliques need a member within two edges: 2 and 3 are one, 3 and 4 are none."""
    queue = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]
    result = candidates_of(queue, 6, monkeypatch, top_cliques=100)
    assert result == [1, 2, 3]


def test_graphs_have_the_ego_and_the_23_vehicles_nearest_to_it(monkeypatch):
    star = [(0, vehicle) for vehicle in range(1, 30)]
    result = candidates_of(star, 30, monkeypatch, top_cliques=100, candidates=100)
    assert result == list(range(1, 24))


def star(vehicles):
    """The ego at risk with each of so many vehicles, which are not with each other."""
    return [(0, vehicle) for vehicle in range(1, 1 + vehicles)]


def test_by_default_the_members_of_three_cliques_score(monkeypatch):
    """Of equally heavy pairs the nearest to the ego."""
    assert candidates_of(star(8), 9, monkeypatch) == [1, 2, 3]


def test_by_default_a_clique_has_four_members(monkeypatch):
    """Of a graph in which all are at risk with each other: the ego and three more."""
    everybody = list(combinations(range(8), 2))
    assert candidates_of(everybody, 8, monkeypatch) == [1, 2, 3]


def test_by_default_there_are_ten_candidates(monkeypatch):
    result = candidates_of(star(15), 16, monkeypatch, top_cliques=100)
    assert result == list(range(1, 11))


def risk(time):
    """The weight by default of a vehicle whose box, grown by 3 m, is met after so many
    seconds at 10 m/s."""
    states = torch.tensor([[0.0, 0, 0, 10], [4.0 + 3.0 + 10.0 * time, 0, 0, 0]])
    return pair_weights(
        states,
        torch.tensor([True, True]),
        size=torch.tensor([4.0, 2.0]).expand(2, 2),
        settings=TopologySettings(),
    )[0, 1].item()


def test_by_default_half_is_the_weight_of_three_seconds():
    assert risk(3.0) == pytest.approx(0.5)


def test_by_default_the_weight_has_a_softness_of_a_second():
    assert risk(4.0) == pytest.approx(1 / (1 + math.e))


@pytest.mark.parametrize(("time", "candidates"), [(5.15, [1]), (5.25, [])])
def test_by_default_a_pair_is_at_risk_up_to_5_2_s(time, candidates):
    """sigma(3 - 5.2) is a tenth."""
    states = torch.tensor([[0.0, 0, 0, 10], [7.0 + 10.0 * time, 0, 0, 0]])
    result = topological_candidates(
        states[None, None],
        torch.ones(1, 1, 2, dtype=torch.bool),
        size=torch.tensor([4.0, 2.0]).expand(1, 2, 2),
        settings=TopologySettings(),
    )
    assert result.candidates[0].nonzero()[:, 0].tolist() == candidates
