"""The verdict on every collision of the ego: whose fault, preventable by whom, which
duty broken (docs/verdicts.md).

A collision counts if it is the ego's fault or a careful and competent driver in its
place would have prevented it. Nobody prevents by braking what comes to an ego that
stands. A verdict on a partner that strikes the ego is `replayed`: it would have driven
differently towards another ego. A clean failure is preventable and not replayed, its
partner broke no duty, no other vehicles hit each other, and nobody left the road.

Where a vehicle moved sideways into the other (`sideways`), that decides whose fault it
is. A standing partner that the ego touches only because its recorded heading turned
makes no failure that counts.

The partner broke the first of these duties that applies: it ran into the ego from
behind; it had crossed a stop line at red; it drove against its lane; it crossed the
ego's path, or came into it, leaving less than a careful and competent driver needs to
brake. It broke none of the first and the last two where the ego moved into it.
"""

import math
from functools import partial

import torch
from torch import Tensor

from e2rl.metrics.catalogue import Batch, declare, event, rate
from e2rl.metrics.contact import FRONT, REAR
from e2rl.metrics.drivers import DRIVERS, HumanDriver
from e2rl.metrics.geometry import travel_heading
from e2rl.metrics.preventable import (
    CREEPING,
    Collision,
    Prevention,
    Tracks,
    along_way,
    driven_length,
    held,
    preventions,
)
from e2rl.scenes.boxes import separation
from e2rl.scenes.lane_graph import against_lanes
from e2rl.scenes.recording import DT, VEHICLE
from e2rl.sim.dynamics import wrap
from e2rl.sim.neighbours import STANDING, STOOD

DUTIES = ("none", "rear-end", "light", "wrong way", "right of way", "entry")
NONE, REAR_END, LIGHT, WRONG_WAY, RIGHT_OF_WAY, ENTRY = range(6)
LIGHT_STEPS = round(5.0 / DT)  # before the contact in which a red light counts
WRONG_STEPS = round(
    1.0 / DT
)  # before the contact of which half must be against the lanes
SAME_WAY = (
    torch.pi / 6
)  # rad between headings below which a vehicle enters the way rather than crosses it
ONCOMING = 5 * torch.pi / 6  # rad from which on it comes towards it
TURN = torch.pi / 7  # rad of heading within the last four seconds that make a turn
TURN_STEPS = round(4.0 / DT)
CUT_IN_STEPS = 10  # 1 s at 10 Hz
TURNED = 1e-3  # rad: a heading that has changed less is the same
AHEAD = 30.0  # m, straight on from the contact, that count as the ego's path
LANE_HALF = 1.75  # m from a lane's centreline to its edge


def duties(
    collision: Collision,
    rear: Tensor,
    red: Tensor,
    lanes: tuple[Tensor, Tensor],
    struck: Tensor,
) -> tuple[Tensor, Tensor]:
    """Returns which duty the partner broke, as an index [B] into DUTIES, and whether
    the ego broke one [B] bool.

    The ego breaks its own by crossing a stop line at red before a vehicle of another
    direction, or by driving against its lane towards a vehicle that keeps to its own.
    Whoever meets it there owes it neither way nor gap.

    Args:
        collision: of B egos.
        rear: [B] bool, the ego is hit at its rear.
        red: [B, 2] int64, step at which the ego and its partner last crossed a stop
            line at red, -1 for never.
        lanes: points [B, M, 2] of the map's centrelines, and which line [B, M] each is
            of (-1: padding).
        struck: [B] bool, see `Prevention`.
    """
    row = torch.arange(len(rear), device=rear.device)
    pair = torch.stack([torch.zeros_like(collision.partner), collision.partner], 1)
    states = held(collision.states, collision.present)[
        row[:, None], :, pair
    ]  # [B, 2, T+1, 4]
    size = collision.size[row[:, None], pair]
    ego, other = states.unbind(1)
    way = travel_heading(ego)
    ahead = travel_heading(other)
    stop = collision.stop
    before = (stop - 1).clamp(min=0)
    turned = torch.stack([_turn(track, stop) for track in (ego, other)])
    angle = wrap(ahead[row, before] - way[row, before])
    entered, safe = _entry(ego, other, size=size, stop=stop)
    crosses = angle.abs() > SAME_WAY
    oncoming = angle.abs() > ONCOMING
    unsafe = entered & (
        ~safe | (oncoming & struck)
    )  # a driver who stands cannot lose the speed of who comes
    # Who turns gives way; where both or none do, the other does if it comes from the
    # ego's left, or leaves its side.
    priority = torch.where(turned[0] == turned[1], angle < 0, turned[1] & ~turned[0])
    priority = torch.where(oncoming, ~turned[0], priority)
    result = torch.full_like(stop, NONE)
    result = torch.where(unsafe & ~crosses, ENTRY, result)
    result = torch.where(unsafe & crosses & priority, RIGHT_OF_WAY, result)
    against = _against(ego, stop, lanes=lanes)
    other_against = _against(other, stop, lanes=lanes)
    ran, other_ran = (
        (red >= 0) & (stop[:, None] - red <= LIGHT_STEPS) & (red <= stop[:, None])
    ).unbind(1)
    ego_broke = ((ran & crosses) | (against & oncoming)) & ~other_against & ~other_ran
    result = result.masked_fill(ego_broke, NONE)
    result = torch.where(other_against, WRONG_WAY, result)
    result = torch.where(other_ran, LIGHT, result)
    faster = other[row, before, 3].abs() * angle.cos() > ego[row, before, 3].abs()
    return torch.where(
        rear & (angle.abs() < torch.pi / 3) & faster, REAR_END, result
    ), ego_broke


def _turn(track: Tensor, stop: Tensor) -> Tensor:
    """Bool [B]: the vehicle at track [B, T+1, 4] turns by more than TURN in the
    TURN_STEPS before stop [B]."""
    steps = torch.arange(track.shape[1] - 1, device=stop.device)
    counted = (steps < stop[:, None]) & (steps >= stop[:, None] - TURN_STEPS)
    return (wrap(track[..., 2].diff(dim=1)) * counted).sum(1).abs() > TURN


def _entry(
    ego: Tensor, other: Tensor, size: Tensor, stop: Tensor
) -> tuple[Tensor, Tensor]:
    """Whether the other came into the ego's way, and whether the gap has at some time
    since the last entry been what a competent driver needs; each [B] bool."""
    tracks = Tracks(
        other[:, :, None],
        size[:, 1:],
        present=torch.ones_like(other[..., :1], dtype=torch.bool),
    )
    along = along_way(ego, size[:, 0, 1], others=tracks)
    outside = along.lateral_gap[..., 0].T > 0
    steps = torch.arange(ego.shape[1], device=stop.device)
    last = torch.where(outside & (steps <= stop[:, None]), steps, -1).amax(
        1, keepdim=True
    )
    gap = along.rear[..., 0].T - driven_length(ego) - size[:, :1, 0] / 2
    safe = gap >= HumanDriver().stopping_gap(
        ego[..., 3].abs() - along.speed[..., 0].T
    ).clamp(min=0.0)
    since = (steps > last) & (steps <= (stop[:, None]).maximum(last + 1))
    return last[:, 0] >= 0, (safe & since).any(1)


def _against(track: Tensor, stop: Tensor, lanes: tuple[Tensor, Tensor]) -> Tensor:
    """Bool [B]: in half of the WRONG_STEPS before stop [B] the lane that the vehicle is
    on runs against it."""
    row = torch.arange(len(stop), device=stop.device)[:, None]
    window = (
        stop[:, None] - torch.arange(1, WRONG_STEPS + 1, device=stop.device)
    ).clamp(min=0)
    states = track[row, window]
    against = against_lanes(*lanes, states[..., :2], travel_heading(states)[..., None])[
        ..., 0
    ]
    return against.float().mean(-1) >= 0.5


def at_fault(
    batch: Batch, *, struck: Tensor, broke: Tensor, prevented: Tensor
) -> Tensor:
    """Returns whether the ego is at fault [B]: 1 or 0, NaN without contact.

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
        batch: B rollouts.
        struck: [B] bool, see `Prevention`.
        broke: [B] bool, the ego broke a duty (`duties`).
        prevented: [B] bool, the human driver prevents the collision.
    """
    row = torch.arange(len(batch["states"]))
    partner = batch["partner"].clamp(min=0)
    speed = batch["states"][row, batch["before"], :, 3].abs()
    moves = speed[:, 0] > STANDING
    partner_moves = speed[row, partner] > STANDING
    leads = batch["kind"] == leading_edge(batch)
    late = cuts_in(batch, CUT_IN_STEPS) | (cuts_in(batch, STOOD) & ~prevented)
    runs_into = leads & partner_moves & ~late & ~struck
    moved, _ = batch["moved_into"].unbind(1)
    runs_into = torch.where(batch["moved_into"].any(1), moved, runs_into)
    genuine = ~turned_on_the_spot(batch)
    fault = moves & (stood(batch, partner) | runs_into) & genuine
    ego_stood = stood(batch, torch.zeros_like(partner))
    fault = fault | (~moves & ego_stood & blocks(batch, partner))
    fault = fault | (broke & ~ego_stood & genuine)
    return fault.to(speed.dtype).masked_fill(~batch["hit"], torch.nan)


def leading_edge(batch: Batch) -> Tensor:
    """Index [B] into KINDS of the edge with which the ego leads: REAR where it
    reverses."""
    row = torch.arange(len(batch["states"]), device=batch["states"].device)
    reverses = batch["states"][row, batch["before"], 0, 3] < -STANDING
    return torch.where(reverses, REAR, FRONT)


def turned_on_the_spot(batch: Batch) -> Tensor:
    """Bool [B]: the partner stands, has turned since it halted (or is first known), and
    the ego would not touch it with the heading that it had then, neither at the contact
    nor within the second after it."""
    states = batch["states"]
    stop = batch["stop"]
    row = torch.arange(len(stop), device=stop.device)
    partner = batch["partner"].clamp(min=0)
    track = states[row, :, partner]
    known = batch["valid"][row, :, partner]
    steps = torch.arange(states.shape[1], device=stop.device)
    moves = (track[..., 3].abs() > STANDING) | ~known
    since = torch.where(moves & (steps < stop[:, None]), steps + 1, 0).amax(1)
    held = torch.cat(
        [track[row, stop, :2], track[row, since, 2:3], track[row, stop, 3:]], -1
    )
    turned = wrap(track[row, stop, 2] - track[row, since, 2]).abs() > TURNED
    later = (stop[:, None] + torch.arange(CUT_IN_STEPS + 1, device=stop.device)).clamp(
        max=states.shape[1] - 1
    )
    ego = states[row[:, None], later, 0]
    size = batch["size"]
    apart = (
        separation(
            ego,
            size[:, :1],
            second=held[:, None],
            second_size=size[row, partner][:, None],
        )
        > 0
    )
    return batch["hit"] & (since < stop) & ~moves[row, stop] & turned & apart.all(1)


def stood(batch: Batch, agent: Tensor) -> Tensor:
    """Bool [B]: the agent [B] has stood for the STOOD steps before the contact, or for
    as long as it is known."""
    row = torch.arange(len(agent), device=agent.device)[:, None]
    window = batch["before"][:, None] - torch.arange(STOOD + 1, device=agent.device)
    known = (window >= 0) & batch["valid"][row, window.clamp(min=0), agent[:, None]]
    moves = (
        batch["states"][row, window.clamp(min=0), agent[:, None], 3].abs() > STANDING
    )
    return known[:, 0] & ~(moves & known).any(1)


def blocks(batch: Batch, partner: Tensor) -> Tensor:
    """Bool [B]: the ego is on a lane that runs as the partner [B] drives, and across
    its own heading."""
    row = torch.arange(len(partner), device=partner.device)
    ego, other = (
        batch["states"][row, batch["before"], agent]
        for agent in (torch.zeros_like(partner), partner)
    )
    onwards = travel_heading(other)
    across = wrap(onwards - ego[:, 2]).sin().abs() > math.sin(SAME_WAY)
    points = batch["lane_points"]
    line = batch["lane_index"]
    begin = points[:, :-1]
    step = points.diff(dim=1)
    along = ((ego[:, None, :2] - begin) * step).sum(-1) / step.square().sum(-1).clamp(
        min=1e-9
    )
    gap = (begin + along.clamp(0, 1)[..., None] * step - ego[:, None, :2]).norm(dim=-1)
    turn = wrap(torch.atan2(step[..., 1], step[..., 0]) - onwards[:, None])
    on_it = (
        (line[:, 1:] == line[:, :-1])
        & (line[:, 1:] >= 0)
        & (gap <= LANE_HALF)
        & (turn.abs() < SAME_WAY)
    )
    return across & on_it.any(1)


def cuts_in(batch: Batch, steps: int) -> Tensor:
    """Bool [B]: at one of the last steps the partner touches no part of the ego's path
    from that step on.

    The path is the ego's own boxes until the contact, and a straight strip of its width
    ahead of the last of them.
    """
    states = batch["states"]
    size = batch["size"]
    stop = batch["stop"]
    partner = batch["partner"].clamp(min=0)[:, None]
    row = torch.arange(len(states), device=states.device)[:, None]
    window = stop[:, None] + torch.arange(-steps, 1, device=states.device)
    known = (window >= 0) & (window < stop[:, None])
    window = window.clamp(min=0)
    other = states[row, window, partner]
    other_size = size[row, partner]
    known = known & batch["valid"][row, window, partner]
    path, path_size = ego_path_boxes(states[row, window, 0], size[:, 0])
    meet = (
        separation(
            other[:, :, None],
            other_size[:, :, None],
            second=path[:, None],
            second_size=path_size[:, None],
        )
        <= 0
    )
    later = torch.ones(meet.shape[-2:], dtype=torch.bool, device=meet.device).triu()
    return (known & ~(meet & later).any(-1)).any(-1)


def ego_path_boxes(states: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Boxes [B, W+1, 4] and sizes [B, W+1, 2] of an ego at states [B, W, 4] and of the
    strip ahead of the last one."""
    last = states[:, -1:]
    onwards = travel_heading(last)
    direction = torch.stack([onwards.cos(), onwards.sin()], -1)
    shift = (size[:, :1] + AHEAD)[..., None] / 2
    strip = torch.cat([last[..., :2] + shift * direction, last[..., 2:]], -1)
    strip_size = torch.stack([torch.full_like(size[:, 0], AHEAD), size[:, 1]], -1)[
        :, None
    ]
    sizes = torch.cat([size[:, None].expand(-1, states.shape[1], -1), strip_size], 1)
    return torch.cat([states, strip], 1), sizes


_MOST = "main adversaries methods egos"
_of_collisions = partial(rate, per_collision=True)
failure = partial(event, raised=1.0)
declare(
    failure(
        "cfr_counted",
        "a failure that counts: preventable, or the ego's fault",
        tables=f"{_MOST} public",
    ),
    failure(
        "cfr_preventable",
        "a failure that a competent driver prevents",
        tables=f"{_MOST} public",
    ),
    failure(
        "cfr_clean",
        "a clean failure: preventable, and nobody else did wrong",
        tables=f"{_MOST} public",
    ),
    _of_collisions("counted", "collisions that count", tables="main adversaries"),
    _of_collisions("at_fault", "ego's fault, per collision", tables=f"{_MOST} public"),
    _of_collisions(
        "preventable",
        "prevented by UN R157's careful and competent driver",
        tables=_MOST,
    ),
    _of_collisions("preventable_fsm", "prevented by the fuzzy safety model"),
    _of_collisions("preventable_rss", "prevented by RSS"),
    _of_collisions("preventable_regulation", "prevented at UN R157's limit"),
    _of_collisions("preventable_chain", "prevented if a follower brakes, too"),
    _of_collisions(
        "replayed",
        "prevented, given that the partner, which strikes the ego, is replayed",
    ),
    events=("duty",),
    words={"duty": DUTIES},
)
_MODELS = tuple(f"preventable_{name}" for name in DRIVERS if name != "human")
COLUMNS = ("preventable", *_MODELS, "preventable_chain", "replayed")


def judge(batch: Batch) -> tuple[Batch, Tensor]:
    """The verdicts on B rollouts, and the way of the driver that they rest on.

    Returns:
        columns: [B] each, NaN where unknown. Of each collision: at_fault, preventable
            (by the human driver) and
            preventable_<model>, counted (0 or 1), preventable_chain (a follower's braking was needed for it), replayed
            (preventable, and the partner strikes the ego), duty (index into DUTIES, -1 without a collision). Of each
            rollout: cfr_counted, cfr_preventable.
        driver: states [B, T+1, 4] of the human driver in the ego's place, NaN without a
            collision.
    """
    hit = batch["hit"]
    driver = torch.full_like(batch["states"][:, :, 0], torch.nan)
    found = {name: torch.full_like(driver[:, 0, 0], torch.nan) for name in COLUMNS}
    duty = torch.full_like(batch["stop"], -1)
    struck = torch.zeros_like(hit)
    broke = torch.zeros_like(hit)
    if hit.any():
        of_hits, duty[hit], broke[hit], human = collision_verdicts(batch, hit)
        driver[hit], struck[hit] = human.states, human.struck
        for name, value in of_hits.items():
            found[name][hit] = value
    fault = at_fault(
        batch, struck=struck, broke=broke, prevented=found["preventable"] == 1
    )
    counted = torch.maximum(fault, found["preventable"])
    known = torch.zeros_like(fault).masked_fill(batch["start_overlap"], torch.nan)
    rates = {"cfr_counted": counted, "cfr_preventable": found["preventable"]}
    rates = {name: torch.where(hit, value, known) for name, value in rates.items()}
    return found | rates | {"at_fault": fault, "counted": counted, "duty": duty}, driver


def collision_verdicts(
    batch: Batch, hit: Tensor
) -> tuple[Batch, Tensor, Tensor, Prevention]:
    """COLUMNS, duty [C], whether the ego broke one [C], and the human driver's
    Prevention of the C collisions hit [B] bool."""
    vehicles = (batch["valid"] & (batch["agent_type"] == VEHICLE)[:, None])[hit]
    collision = Collision(
        batch["states"][hit],
        vehicles,
        size=batch["size"][hit],
        partner=batch["partner"][hit],
        stop=batch["stop"][hit],
    )
    row = torch.arange(len(collision.stop))
    ran = batch.get("ran_light")
    pair = torch.stack([torch.zeros_like(collision.partner), collision.partner], 1)
    red = torch.full_like(pair, -1) if ran is None else ran[hit].gather(1, pair)
    lanes = (batch["lane_points"][hit], batch["lane_index"][hit])
    result = preventions(collision)
    leads = leading_edge(batch)[hit]
    trailing = batch["kind"][hit] == torch.where(leads == FRONT, REAR, FRONT)
    duty, ego_broke = duties(
        collision, trailing, red=red, lanes=lanes, struck=result["human"].struck
    )
    ego_moved, partner_moved = batch["moved_into"][hit].unbind(1)
    kept_its_way = ego_moved & ~partner_moved & (duty != LIGHT) & (duty != WRONG_WAY)
    duty = duty.masked_fill(kept_its_way, NONE)
    dtype = batch["states"].dtype
    speed = batch["states"][hit][row, batch["before"][hit], :, 3].abs()
    moves = speed[:, 0] > CREEPING
    partner_moves = speed[row, collision.partner] > STANDING
    counts = moves & ~turned_on_the_spot(batch)[hit]
    found = {
        f"preventable_{name}": (value.avoided & counts).to(dtype)
        for name, value in result.items()
    }
    human = result["human"]
    found["preventable"] = found.pop("preventable_human")
    found["preventable_chain"] = found["preventable"] * (human.followers > 0)
    found["replayed"] = found["preventable"] * (
        partner_moves & (batch["kind"][hit] != leads)
    )
    return found, duty, ego_broke & (duty != REAR_END), human


def clean(found: Batch) -> Tensor:
    """cfr_clean [B] of the columns of B rollouts: 1 for a clean failure, NaN where
    `cfr_preventable` is unknown."""
    wrong = (found["duty"] > NONE) | (found["replayed"] == 1) | (found["cfr_bg"] == 1)
    wrong = wrong | (found["aor_any"] == 1) | (found["ego_off_road"] == 1)
    return found["cfr_preventable"].where(
        ~wrong | found["cfr_preventable"].isnan(), 0.0
    )
