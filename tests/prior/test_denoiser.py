"""The joint denoiser: equivariant under permutations of vehicles, blind to absent ones,
a mix of x and network."""

import torch

from e2rl.prior.denoiser import Denoiser
from e2rl.prior.features import EDGE, NODE
from e2rl.prior.lane_relative import SIZE
from e2rl.run.fused import switch
from tests.prior.small import small_prior

BATCH = 2
VEHICLES = 6


def inputs(seed=0):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn((BATCH, VEHICLES, *shape), generator=generator)  # noqa: E731
    present = torch.tensor([[True] * 6, [True, True, False, True, False, False]])
    return (
        draw(SIZE),
        torch.rand(BATCH, VEHICLES, generator=generator),
        draw(NODE),
        draw(VEHICLES, EDGE),
        present,
    )


def run(
    net,
    x,
    level,
    nodes,
    pairs,
    present,
):
    return net(x, level, net.encode(nodes, pairs, present))


def test_vehicles_may_be_listed_in_any_order():
    net, (x, level, nodes, pairs, present) = small_prior().denoiser, inputs()
    order = torch.tensor([3, 0, 5, 1, 4, 2])
    place = run(
        net,
        x[:, order],
        level=level[:, order],
        nodes=nodes[:, order],
        pairs=pairs[:, order][:, :, order],
        present=present[:, order],
    )
    torch.testing.assert_close(
        place,
        run(
            net,
            x,
            level=level,
            nodes=nodes,
            pairs=pairs,
            present=present,
        )[:, order],
        rtol=0,
        atol=1e-5,
    )


def test_absent_vehicles_do_not_influence_the_others():
    net, (x, level, nodes, pairs, present) = small_prior().denoiser, inputs()
    here = run(
        net,
        x,
        level=level,
        nodes=nodes,
        pairs=pairs,
        present=present,
    )
    hidden = ~present
    x = x.clone()
    nodes = nodes.clone()
    pairs = pairs.clone()
    x[hidden], nodes[hidden] = 50.0, -9.0
    pairs[hidden[:, None, :].expand(pairs.shape[:3])] = 7.0
    place = run(
        net,
        x,
        level=level,
        nodes=nodes,
        pairs=pairs,
        present=present,
    )
    torch.testing.assert_close(
        place[present],
        here[present],
        rtol=0,
        atol=0,
    )


def test_present_vehicles_influence_each_other():
    net, (x, level, nodes, pairs, present) = small_prior().denoiser, inputs()
    here = run(
        net,
        x,
        level=level,
        nodes=nodes,
        pairs=pairs,
        present=present,
    )
    x = x.clone()
    x[:, 1] += 1
    assert (
        run(
            net,
            x,
            level=level,
            nodes=nodes,
            pairs=pairs,
            present=present,
        )[0, 3]
        != here[0, 3]
    ).any()


def test_an_untrained_denoiser_scales_x_and_a_clean_one_keeps_it():
    x, level, nodes, pairs, present = inputs()
    net = Denoiser()
    torch.testing.assert_close(
        run(
            net,
            x,
            level=level,
            nodes=nodes,
            pairs=pairs,
            present=present,
        ),
        net.schedule.alpha(level)[..., None] * x,
    )
    clean = run(
        small_prior().denoiser,
        x,
        level=torch.zeros_like(level),
        nodes=nodes,
        pairs=pairs,
        present=present,
    )
    torch.testing.assert_close(clean, x)


def test_a_repeated_encoding_is_that_of_a_repeated_batch():
    net, (x, level, nodes, pairs, present) = small_prior().denoiser, inputs()
    tiled = net.encode(nodes, pairs, present).repeat(2)
    both = net(torch.cat([x, x + 1]), torch.cat([level, level]), tiled)
    torch.testing.assert_close(
        both[BATCH:],
        run(
            net,
            x + 1,
            level=level,
            nodes=nodes,
            pairs=pairs,
            present=present,
        ),
        rtol=0,
        atol=1e-5,
    )


def test_weights_have_gradients_where_functions_are_fused_too():
    net, (x, level, *scene) = (
        small_prior().denoiser.requires_grad_(True).eval(),
        inputs(),
    )
    switch(True)
    run(net, x, level[:1], *scene).square().sum().backward()
    assert all(weight.grad is not None for weight in net.parameters())
