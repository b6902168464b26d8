"""Mission: limits along it, and lines that are run at red."""

import torch

from e2rl.scenes.recording import LIGHT_GREEN, LIGHT_RED
from e2rl.sim.mission import limit_at, mission_of, ran_red
from tests.synthetic import BACK, make_scenes


def test_limits_are_read_at_the_nearest_vertex():
    scene = make_scenes(1, limit=9.0).scenes
    scene["route_limit"][0, 0, 0, 20:] = 14.0
    limit = limit_at(mission_of(scene), torch.tensor([[0.0, 38.0, 40.0, 1000.0]]))
    assert limit.tolist() == [[9.0, 9.0, 14.0, 14.0]]


def test_end_is_infinite_where_the_route_goes_on():
    assert (
        mission_of(make_scenes(1, road=(-60.0, 90.0)).scenes).end.item() == 90.0 + BACK
    )
    assert mission_of(make_scenes(1).scenes).end.isinf().all()


def test_a_line_is_run_at_the_step_at_which_the_front_passes_it_at_red():
    light_state = torch.full((1, 6, 2), LIGHT_GREEN)
    light_state[0, 3:, 0] = LIGHT_RED
    front = torch.tensor([[8.0, 9.0, 9.9, 10.1, 11.0, 12.0]])
    light = torch.tensor([[0, -1]])
    line = torch.tensor([[10.0, 9.5]])
    assert ran_red(
        light_state,
        light,
        line=line,
        front=front,
    ).tolist() == [3]
    assert ran_red(
        light_state,
        torch.tensor([[1, -1]]),
        line=line,
        front=front,
    ).tolist() == [-1], "green"
    assert ran_red(
        light_state,
        light,
        line=line + 5,
        front=front,
    ).tolist() == [-1], "it halts before the line"
    assert ran_red(
        light_state[..., :0],
        light,
        line=line,
        front=front,
    ).tolist() == [-1], "no lights"
