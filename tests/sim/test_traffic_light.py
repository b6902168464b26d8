"""Who ran a red light."""

import torch

from e2rl.scenes.recording import LIGHT_GREEN, LIGHT_RED
from e2rl.sim.mission import ran_red


def test_a_line_is_run_at_the_step_at_which_the_front_passes_it_at_red():
    light_state = torch.full((1, 6, 2), LIGHT_GREEN)
    light_state[0, 3:, 0] = LIGHT_RED
    front = torch.tensor([[8.0, 9.0, 9.9, 10.1, 11.0, 12.0]])
    light, line = torch.tensor([[0, -1]]), torch.tensor([[10.0, 9.5]])
    assert ran_red(light_state, light, line, front).tolist() == [3]
    assert ran_red(light_state, torch.tensor([[1, -1]]), line, front).tolist() == [-1], "green"
    assert ran_red(light_state, light, line + 5, front).tolist() == [-1], "it halts before the line"
    assert ran_red(light_state[..., :0], light, line, front).tolist() == [-1], "no lights"
