"""Plans as vehicles drive them: on the planned line, at the planned speed, by the
unicycle of the simulator.

A decoder moves a vehicle along its route at the planned speed. Beside the route (inside
or outside of a bend) and at an angle to it the vehicle's own line is longer or shorter
than the route, so it would be faster or slower than it says. Here the planned line is
driven instead: as many metres of it as the speed makes.
"""

from dataclasses import replace

import torch
from torch import Tensor

from e2rl.prior.lane_relative import LEAST_STRETCH, LaneState, select
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import rolling_back, steered, turn_bound, wrap

# What is looked up where the vehicle is on its line.
ALONG_LINE = ("s", "d", "d1", "d2", "heading", "kappa")
TINY = 1e-6  # m: a shorter piece of a line is none


def as_driven(motion: LaneState, state: LaneState, on_lane: Tensor) -> LaneState:
    """The motion that a unicycle makes of a plan: each step is the mean speed long,
    along the mean heading.

    Args:
        motion: the plan, fields [..., H].
        state: where it begins, fields [...].
        on_lane: [...] bool, whether the plan is relative to a route; a plan in free
            space has no other line.

    Returns:
        Fields [..., H]; speed and acceleration are those of the plan, all else is that
        of the place on the planned line that is reached by then. Turns are bounded by
        curvature and lateral acceleration. Who reverses rolls to a halt before it
        drives as planned.
    """
    times = DT * torch.arange(1, motion.v.shape[-1] + 1, device=motion.v.device)
    back = rolling_back(state.v[..., None], times)
    motion = replace(motion, v=torch.where(back < 0, back, motion.v))
    before = torch.cat([state.v[..., None], motion.v[..., :-1]], -1)
    driven = ((before + motion.v) / 2 * DT).cumsum(-1)
    placed = _placed(
        motion,
        state,
        driven=driven,
        on_lane=on_lane,
    )
    placed = select(state.v < 0, motion, placed)  # no line lies behind the vehicle
    headings = torch.cat([state.heading[..., None], placed.heading], -1)
    bound = turn_bound((before + motion.v) / 2)
    turn = torch.maximum(torch.minimum(wrap(headings.diff(dim=-1)), bound), -bound)
    x, y, heading, _ = steered(state.states(), motion.v, turn=turn).unbind(-1)
    return replace(
        placed,
        x=x,
        y=y,
        heading=heading,
    )


def _placed(
    motion: LaneState,
    state: LaneState,
    *,
    driven: Tensor,
    on_lane: Tensor,
) -> LaneState:
    """The motion with its places ALONG_LINE those after `driven` [..., H] m of its
    line."""
    along = (1 - (motion.kappa - motion.d2) * motion.d).clamp(min=LEAST_STRETCH)
    stretch = torch.hypot(along, motion.d1)  # m of the line per m of the route
    stretch = torch.where(on_lane[..., None], stretch, 1.0)
    mean = (stretch + torch.cat([stretch[..., :1], stretch[..., :-1]], -1)) / 2
    metres = (
        mean
        * motion.s.diff(
            dim=-1,
            prepend=state.s[..., None],
        )
    ).cumsum(-1)
    metres = torch.nn.functional.pad(metres, (1, 0))

    whole = state.map(
        lambda begin, rest: torch.cat([begin[..., None], rest], -1), motion
    )
    turned = wrap(whole.heading.diff(dim=-1)).cumsum(-1)
    begin = whole.heading[..., :1]
    whole.heading = torch.cat([begin, begin + turned], -1)
    table = torch.stack([getattr(whole, name) for name in ALONG_LINE], -2)

    last = metres.shape[-1] - 1
    after = torch.searchsorted(metres, driven.contiguous()).clamp(1, last)
    low = metres.gather(-1, after - 1)
    high = metres.gather(-1, after)
    part = ((driven - low) / (high - low).clamp(min=TINY)).clamp(0, 1)[..., None, :]
    index = after[..., None, :].expand(*table.shape[:-1], after.shape[-1])
    values = torch.lerp(table.gather(-1, index - 1), table.gather(-1, index), part)
    places = dict(zip(ALONG_LINE, values.unbind(-2), strict=True))
    beyond = (driven - metres[..., -1:]).clamp(min=0)  # the line goes on as it ends
    places["s"] = places["s"] + beyond / stretch[..., -1:]
    places["heading"] = places["heading"] + beyond * motion.kappa[..., -1:]
    return replace(motion, **places)
