import networkx
import numpy as np
import pytest
import shapely
import torch

from e2rl.run.errors import InputError
from e2rl.scenes.boxes import corners
from e2rl.traffic.e2.topology import (
    TopologySettings,
    maximal_cliques,
    pair_weights,
    time_to_collision,
    topological_candidates,
)


def random_boxes(count, n, spread, seed):
    generator = torch.Generator().manual_seed(seed)
    states = torch.rand(count, n, 4, generator=generator, dtype=torch.float64)
    states = (states - torch.tensor([0.5, 0.5, 0.5, 0.0])) * torch.tensor([2 * spread, 2 * spread, 6.28, 15.0])
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
    states, size = random_boxes(120, 2, 15.0, 0)
    closed = time_to_collision(states, size)
    assert torch.equal(closed, closed.transpose(-1, -2))
    time = torch.arange(0, 8.0, 0.01, dtype=torch.float64)
    velocity = states[..., 3:] * torch.stack([states[..., 2].cos(), states[..., 2].sin()], -1)
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
        elif ttc.isfinite():  # shorter than a step: the outlines must touch at that moment
            assert shapely.distance(*at(ttc[None]))[0] < 1e-9
    assert set(kinds) == {"now", "later", "never"}


def test_ttc_of_a_follower_and_of_equal_speeds():
    states = torch.tensor([[0.0, 0, 0, 10], [24, 0, 0, 5], [-30, 0, 0, 10]])
    ttc = time_to_collision(states, torch.tensor([4.0, 2.0]).expand(3, 2))
    assert ttc[0, 1] == pytest.approx(4.0) and ttc[0, 2] == torch.inf and ttc[0, 0] == 0


def test_weight_is_half_at_tau_max_and_nothing_for_the_absent():
    settings = TopologySettings(clearance=0.0)
    states = torch.tensor([[0.0, 0, 0, 10], [34, 0, 0, 0], [30, 0, 0, 0]])
    weight = pair_weights(states, torch.tensor([True, True, False]), torch.tensor([4.0, 2.0]).expand(3, 2), settings)
    assert weight[0, 1] == pytest.approx(0.5) and weight[2].sum() == 0 and weight.diagonal().sum() == 0


def test_cliques_are_those_of_networkx():
    generator = np.random.default_rng(0)
    adjacency = np.triu(generator.random((9, 9)) < 0.5, 1)
    adjacency = (adjacency | adjacency.T).astype(np.uint8)
    expected = {tuple(sorted(c)) for c in networkx.find_cliques(networkx.from_numpy_array(adjacency)) if len(c) > 1}
    assert set(maximal_cliques(adjacency.tobytes(), 9)) == expected


def test_permuting_vehicles_permutes_scores_and_candidates():
    states, size = random_boxes(4, 14, 30.0, 1)
    track, valid = rollout(states), torch.rand(4, 81, 14) < 0.95
    valid[:, 0] = True
    settings = TopologySettings(candidates=4, max_nodes=10)
    result = topological_candidates(track, valid, size, settings)
    order = torch.cat([torch.zeros(1, dtype=torch.int64), 1 + torch.randperm(13)])
    permuted = topological_candidates(track[:, :, order], valid[:, :, order], size[:, order], settings)
    assert torch.equal(permuted.score, result.score[:, order])
    assert torch.equal(permuted.candidates, result.candidates[:, order])
    assert result.candidates.any()


@pytest.mark.parametrize("count", [1, 2, 48])
def test_the_ego_is_never_a_candidate_whatever_the_number_of_vehicles(count):
    states, size = random_boxes(2, count, 25.0, 2)
    present = torch.ones(2, 81, count, dtype=torch.bool)
    result = topological_candidates(rollout(states), present, size, TopologySettings())
    assert not result.candidates[:, 0].any() and result.weights.shape == (2, 17, count, count)
    assert (result.candidates.sum(1) <= 10).all() and (result.score[result.candidates] > 0).all()


def test_two_vehicles_head_on_are_one_clique():
    states = torch.tensor([[[0.0, 0, 0, 10], [70, 0, torch.pi, 10]]])
    result = topological_candidates(
        rollout(states),
        torch.ones(1, 81, 2, dtype=torch.bool),
        torch.tensor([[[4.0, 2.0]]]).expand(1, 2, 2),
        TopologySettings(),
    )
    assert result.candidates.tolist() == [[False, True]]
    assert (0, 1) in result.cliques[0][0] and result.weights[0, 0, 0, 1] >= TopologySettings().edge_threshold


def test_absent_vehicles_are_left_out():
    states = torch.tensor([[[0.0, 0, 0, 10], [40, 0, torch.pi, 10], [45, 1, torch.pi, 10]]])
    valid = torch.ones(1, 81, 3, dtype=torch.bool)
    valid[..., 1] = False
    result = topological_candidates(rollout(states), valid, torch.full((1, 3, 2), 2.0), TopologySettings())
    assert result.candidates.tolist() == [[False, False, True]]


@pytest.mark.parametrize(("x", "y", "counts"), [(200.0, 50.0, False), (40.0, 0.0, True)])
def test_a_queue_counts_only_where_the_ego_is_entangled_with_it(x, y, counts):
    queue = [[x + 5 * k, y, 0, 0] for k in range(4)]
    states, present = torch.tensor([[[0.0, 0, 0, 10], *queue]]), torch.ones(1, 81, 5, dtype=torch.bool)
    size = torch.tensor([[[4.5, 2.0]]]).expand(1, 5, 2)
    assert topological_candidates(rollout(states), present, size, TopologySettings()).candidates.any() == counts


def test_large_cliques_are_cut_down_and_keep_the_ego():
    states, size = random_boxes(1, 8, 1.0, 3)
    result = topological_candidates(
        states[:, None], torch.ones(1, 1, 8, dtype=torch.bool), size, TopologySettings(max_clique=3)
    )
    assert all(len(clique) == 3 and clique[0] == 0 for clique in result.cliques[0][0])


def test_bad_settings_name_their_key():
    with pytest.raises(InputError, match="max_clique"):
        TopologySettings(max_clique=1)
    with pytest.raises(InputError, match="edge_threshold"):
        TopologySettings(edge_threshold=1.5)
