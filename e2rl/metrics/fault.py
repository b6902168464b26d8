"""Whose fault a collision is (docs/reference/verdicts.md)."""

import math

import torch
from torch import Tensor

from e2rl.metrics.collisions import EGO, PARTNER, Collisions
from e2rl.metrics.contact import FRONT, REAR
from e2rl.metrics.geometry import from_segment, travel_heading
from e2rl.scenes.boxes import angle_of, separation, unit_vectors
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import wrap
from e2rl.sim.neighbours import STANDING, STOOD

CUT_IN_STEPS = round(1.0 / DT)  # before the contact: who enters the path later cuts in
TURNED = 1e-3  # rad: a heading that has changed less is the same
AHEAD = 30.0  # m, straight on from the contact, that count as the ego's path
LANE_HALF = 1.75  # m from a lane's centreline to its edge
LANE_ANGLE = math.radians(30)  # between headings of who drives along a lane, and it


def ego_at_fault(
    collisions: Collisions,
    moved_into: Tensor,
    *,
    struck: Tensor,
    broke: Tensor,
    prevented: Tensor,
) -> Tensor:
    """Whether the ego is at fault [C] bool.

    It is if it moves and its partner has stood for STOOD steps. Else, where the ego
    moved sideways into its partner or that into the ego, it is if the ego did. Else it
    is if it moves and its leading edge (the front, of an ego that reverses the rear)
    hits a partner that moves and did not cut in: that entered the ego's path more than
    a second before the contact, or two where no competent driver prevents it. It is not
    where a competent driver who stands would be struck all the same. An ego that stands
    is, if it has stood for STOOD steps in the way of a lane that the partner comes
    along. It is, whichever edge is hit, where it broke a duty of its own and has not
    stood for STOOD steps. Nobody is where the partner stands and has only turned on the
    spot.

    Args:
        collisions: C of them.
        moved_into: [C, 2] bool, see `sideways`.
        struck: [C] bool, see `Prevention`.
        broke: [C] bool, the ego broke a duty (`duties`).
        prevented: [C] bool, the human driver prevents the collision.
    """
    moves, partner_moves = is_moving(collisions).unbind(1)
    ego_stood, partner_stood = has_stood(collisions).unbind(1)
    cuts_in = enters_path(collisions, CUT_IN_STEPS) | (
        enters_path(collisions, STOOD) & ~prevented
    )
    runs_into = (collisions.kind == leading_edge(collisions)) & partner_moves
    runs_into = runs_into & ~cuts_in & ~struck
    runs_into = torch.where(moved_into.any(1), moved_into[:, EGO], runs_into)
    genuine = ~turned_on_the_spot(collisions)
    fault = moves & (partner_stood | runs_into) & genuine
    fault = fault | (~moves & ego_stood & blocks_lane(collisions))
    return fault | (broke & ~ego_stood & genuine)


def is_moving(collisions: Collisions) -> Tensor:
    """Bool [C, 2]: faster than STANDING at the step before the contact."""
    return collisions.states_at(collisions.before)[..., 3].abs() > STANDING


def leading_edge(collisions: Collisions) -> Tensor:
    """Index [C] into KINDS of the edge with which the ego leads: REAR where it
    reverses."""
    reverses = collisions.states_at(collisions.before)[:, EGO, 3] < -STANDING
    return torch.where(reverses, REAR, FRONT)


def trailing_edge(collisions: Collisions) -> Tensor:
    """Index [C] into KINDS of the edge opposite to the leading one."""
    return torch.where(leading_edge(collisions) == FRONT, REAR, FRONT)


def has_stood(collisions: Collisions) -> Tensor:
    """Bool [C, 2]: a vehicle has stood for the STOOD steps before the contact, or for
    as long as it is known."""
    window = collisions.before[:, None] - torch.arange(STOOD + 1)
    present = collisions.known_at(window)
    speed = collisions.states_at(window.clamp(min=0))[..., 3].abs()
    return present[:, 0] & ~((speed > STANDING) & present).any(1)


def enters_path(collisions: Collisions, steps: int) -> Tensor:
    """Bool [C]: at one of the last steps the partner touches no part of the ego's path
    from that step on.

    The path is the ego's own boxes until the contact, and a straight strip of its width
    ahead of the last of them.
    """
    window = collisions.stop[:, None] + torch.arange(-steps, 1)
    present = collisions.known_at(window)[..., PARTNER] & (
        window < collisions.stop[:, None]
    )
    states = collisions.states_at(window.clamp(min=0))
    path, path_size = path_boxes(states[:, :, EGO], collisions.size[:, EGO])
    gap = separation(
        states[:, :, None, PARTNER],
        collisions.size[:, None, None, PARTNER],
        second=path[:, None],
        second_size=path_size[:, None],
    )
    later = torch.ones(gap.shape[-2:], dtype=torch.bool).triu()
    return (present & ~((gap <= 0) & later).any(-1)).any(-1)


def path_boxes(states: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Boxes [C, W+1, 4] and sizes [C, W+1, 2] of an ego at states [C, W, 4] of size
    [C, 2], and of the strip of AHEAD m ahead of the last one."""
    last = states[:, -1:]
    heading = travel_heading(last)
    direction = unit_vectors(heading)
    shift = (size[:, :1] + AHEAD)[..., None] / 2
    strip = torch.cat([last[..., :2] + shift * direction, last[..., 2:]], -1)
    sizes = size[:, None].repeat(1, states.shape[1] + 1, 1)
    sizes[:, -1, 0] = AHEAD
    return torch.cat([states, strip], 1), sizes


def turned_on_the_spot(collisions: Collisions) -> Tensor:
    """Bool [C]: the partner stands, has turned from its halt (or first step) on, and
    the ego would not touch it with the heading that it had then, neither at the contact
    nor within the second after it."""
    stop = collisions.stop
    row = torch.arange(len(stop))
    states = collisions.states[:, :, PARTNER]
    steps = torch.arange(states.shape[1])
    moves = (states[..., 3].abs() > STANDING) | ~collisions.valid[..., PARTNER]
    halt = torch.where(moves & (steps < stop[:, None]), steps + 1, 0).amax(1)
    at_halt = states[row, halt, 2]
    at_stop = states[row, stop].clone()
    turned = wrap(at_stop[:, 2] - at_halt).abs() > TURNED
    at_stop[:, 2] = at_halt
    later = stop[:, None] + torch.arange(CUT_IN_STEPS + 1)
    later = later.clamp(max=states.shape[1] - 1)
    gap = separation(
        collisions.states_at(later)[:, :, EGO],
        collisions.size[:, None, EGO],
        second=at_stop[:, None],
        second_size=collisions.size[:, None, PARTNER],
    )
    return (halt < stop) & ~moves[row, stop] & turned & (gap > 0).all(1)


def blocks_lane(collisions: Collisions) -> Tensor:
    """Bool [C]: the ego is on a lane that runs as the partner drives, and across its
    own heading."""
    ego, partner = collisions.states_at(collisions.before).unbind(1)
    direction = travel_heading(partner)
    across = wrap(direction - ego[:, 2]).sin().abs() > math.sin(LANE_ANGLE)
    line = collisions.lane_index
    start = collisions.lane_points[:, :-1]
    along = collisions.lane_points.diff(dim=1)
    gap = from_segment(
        ego[:, None, :2],
        start,
        along=along,
    ).norm(dim=-1)
    turn = wrap(angle_of(along) - direction[:, None])
    is_lane = (line[:, 1:] == line[:, :-1]) & (line[:, 1:] >= 0)
    runs_there = is_lane & (gap <= LANE_HALF) & (turn.abs() < LANE_ANGLE)
    return across & runs_there.any(1)
