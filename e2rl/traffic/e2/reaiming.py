"""Re-aiming: vehicles of replayed traffic leave it at a random moment and re-aim at the
ego every 0.5 s.

A policy that trains on replayed attacks learns where the adversary will not be. One
that re-aims must be reacted to. It takes the constant acceleration and path curvature
that best meet the ego at one of ten moments ahead, within the limits of an interception
(`InterceptionSettings`). It knows of the ego, and owes it, what adversaries of e2 do:
it predicts it from its present motion, and yields by the same rules (`responsibility`,
`prior.bounds`).
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from e2rl.prior.bounds import (
    LATERAL_MARGIN,
    STRIDE,
    WAIT,
    BoundSettings,
    Duty,
    Meeting,
    meeting_braking,
)
from e2rl.run.errors import InputError
from e2rl.run.settings import configured, setting
from e2rl.scenes.boxes import separation, to_frame
from e2rl.scenes.drivable_area import off_road
from e2rl.scenes.recording import DT
from e2rl.sim.dynamics import HOLD, SHARPEST, TURN, Arc, along_arc, curvature_of
from e2rl.sim.world import World
from e2rl.traffic.e2.interception import (
    ACCEL_COST,
    LATERAL_COST,
    MAX_BEARING,
    SHOULDER,
    TIME_COST,
    InterceptionSettings,
)
from e2rl.traffic.motion import TOP_SPEED
from e2rl.traffic.responsibility import (
    RESPONSIBILITIES,
    YieldingSettings,
    duty_of,
    leading,
)
from e2rl.traffic.traffic import REPLAN_STEPS, SINGLE

MOMENTS = 10  # at which the ego may be met, one every 0.5 s
CHECKED, RUN_ON = (
    3,
    2.0,
)  # points of a path that must be drivable, evenly spaced in time, for at least so many s
TOUCH = 0.4  # fraction of both lengths by which boxes that move alike touch before their centres meet
MISS_COST = 1.0  # s that 1 m by which the ego is missed weighs, against the costs of an interception
UNAIMED = 1.0  # m/s^2 of braking without an aim
ALONG = 0.9  # cosine between headings from which on a vehicle follows the ego where they meet
SEEN = 3  # nearest others that a vehicle brakes for


def surroundings(world: World, rows: Tensor, agents: Tensor) -> World:
    """What vehicles agents [K] of environments rows [K] see: a World [K] of the ego,
    the vehicle itself, and the SEEN agents nearest to it; of its scene the sizes."""
    k = torch.arange(len(rows), device=rows.device)
    xy = world.states[rows, :, :2]
    gap = (xy - xy[k, agents, None]).square().sum(-1)
    counts = world.valid[rows]
    counts[:, 0] = counts[k, agents] = False
    near = gap.masked_fill(~counts, torch.inf).topk(
        min(SEEN, gap.shape[1]), largest=False
    )
    at = (
        rows[:, None],
        torch.cat(
            [torch.zeros_like(agents)[:, None], agents[:, None], near.indices], 1
        ),
    )
    valid = torch.cat(
        [
            world.valid[rows, :1],
            torch.ones_like(agents)[:, None].bool(),
            near.values < torch.inf,
        ],
        1,
    )
    scene = TensorDict({"size": world.scene["size"][at]}, batch_size=rows.shape)
    return World(
        scene,
        world.step[rows],
        states=world.states[at],
        valid=valid,
        accel=world.accel[at],
        turn_rate=world.turn_rate[at],
    )


class Ground(NamedTuple):
    """Drivable fields [B, G, G] of environments, their origins [B, 2], and the
    environments row [K] of K vehicles."""

    field: Tensor
    origin: Tensor
    row: Tensor


def best_aim(
    states: Tensor,
    target: Tensor,
    lengths: Tensor,
    eta: Tensor,
    ground: Ground,
    limits: InterceptionSettings,
) -> Arc:
    """The Arc of vehicles states [K, 4] that best meets the ego, target [K, MOMENTS,
    4], within `limits` at intensities eta [K]; lengths [K]: of both together.

    At each moment: the arc through the target, at the acceleration that arrives in
    time; both clamped to the limits. The cheapest of those with a drivable path is
    taken; NaN where there is none, or the target is not ahead.
    """
    times = moments(states)
    v = states[:, 3:]
    dial = eta[:, None]
    local = to_frame(target[..., :2], states[:, None])
    bearing = torch.atan2(local[..., 1], local[..., 0])
    chord = local.norm(dim=-1)
    length = chord / torch.sinc(bearing / torch.pi).clamp(min=0.1)
    alike = (states[:, 2:3] + 2 * bearing - target[..., 2]).cos().square()
    touch = TOUCH * lengths[:, None] * alike
    accel = 2 * (length - touch - v * times) / times**2
    top = torch.minimum(limits.push * dial, (v.clamp(min=TOP_SPEED) - v) / times)
    accel = torch.minimum(accel.maximum(-limits.brake * dial), top).maximum(-v / times)
    fastest = torch.maximum(v, v + accel * times)
    bound = (limits.lateral * dial / fastest.square().clamp(min=1e-3)).clamp(
        max=SHARPEST
    )
    curvature = torch.minimum(
        (2 * bearing.sin() / chord.clamp(min=0.1)).maximum(-bound), bound
    )
    aim = Arc(accel, curvature)
    portions = torch.arange(1, CHECKED + 1, device=times.device) / CHECKED
    looked_at = torch.cat(
        [times[:, None], times[:, None].clamp(min=RUN_ON) * portions], 1
    )
    path, _ = along_arc(states[:, None], aim, times=looked_at)
    miss = ((path[:, :, 0, :2] - target[..., :2]).norm(dim=-1) - touch).clamp(min=0)
    cost = MISS_COST * miss + ACCEL_COST * accel.abs() + TIME_COST * times
    cost = cost + LATERAL_COST * fastest.square() * curvature.abs()
    beyond = off_road(
        torch.cat([states[:, None, :2], path[..., :2].flatten(1, 2)], 1), *ground
    )
    furthest = beyond[:, 1:].view(path.shape[:-1]).amax(-1)
    ok = (bearing.abs() < MAX_BEARING) & (furthest <= beyond[:, :1].clamp(min=SHOULDER))
    cost, pick = cost.masked_fill(~ok, torch.inf).min(-1, keepdim=True)
    none = cost[:, 0].isinf()
    return Arc(
        *(value.gather(1, pick)[:, 0].masked_fill(none, torch.nan) for value in aim)
    )


def moments(like: Tensor) -> Tensor:
    """Times [MOMENTS] s at which the ego may be met."""
    return DT * REPLAN_STEPS * torch.arange(1, MOMENTS + 1, device=like.device)


def braking_for(
    world: World, aim: Arc, motion: Arc, duty: Duty, bounds: BoundSettings
) -> Tensor:
    """Braking [K] (negative: none is needed) that vehicles owe the ego (duty, [K, 1])
    and those near them, if they drive their aim [K] and the others go on as they do:
    motion [K, N] of `surroundings`."""
    steps = torch.arange(
        STRIDE, round(bounds.look / DT) + 1, STRIDE, device=aim.accel.device
    )
    own, driven = along_arc(world.states[:, 1], aim, times=DT * steps)
    index = [0, *range(2, world.states.shape[1])]
    states = world.states[:, index]
    going_on = Arc(*(value[:, index] for value in motion))
    tracks, _ = along_arc(
        states, going_on, times=DT * steps, hold=HOLD, turn=TURN
    )  # [K, J, T, 4]
    size = world.scene["size"]
    wide = size[:, 1] + size.new_tensor([0.0, 2 * LATERAL_MARGIN])
    meets = (
        separation(
            own[:, None],
            wide[:, None, None],
            second=tracks,
            second_size=size[:, index][:, :, None],
        )
        < 0
    )
    meets = meets & world.valid[:, index][..., None]
    first = meets.int().argmax(-1)
    at = first[..., None, None].expand(*first.shape, 1, 4)
    own = own[:, None].expand_as(tracks).gather(2, at)[:, None, :, 0]
    other = tracks.gather(2, at)[:, None, :, 0]
    across = (other[:, :, :1, 2] - own[:, :, :1, 2]).cos() < ALONG
    other[
        :, :, :1, 3
    ] *= ~across  # whoever turns into the ego's side must stop short of it, not drive as fast as it
    speed = (
        world.states[:, 1, 3] + aim.accel.clamp(min=0) * WAIT
    )  # if it does not brake before it decides again
    meeting = Meeting(
        own,
        other,
        driven=driven.gather(1, first)[:, None],
        steps=steps[first][:, None],
        happens=meets.any(-1)[:, None],
    )
    length = (size[:, :1, 0] + size[:, 1:2, 0]) / 2
    return meeting_braking(meeting, speed[:, None], length=length, duty=duty)[:, 0]


NEAR, MOVING = 50.0, 1.0  # m from the ego and m/s: other vehicles that may react
LATEST = 0.6  # fraction of the episode in which vehicles begin to react
MOST = 2  # vehicles that react in an episode
NEVER = 1 << 30


@configured("learner/ppo_bc", "react")
@dataclass(frozen=True)
class ReactSettings:
    """Fields: `react` in conf/learner/ppo_bc.yaml."""

    fraction: float = setting(low=0, high=1)
    others: float = setting(low=0, high=1)
    eta: tuple[float, float] | None = setting(low=0, optional=True)
    scatter: float = setting(low=0)
    responsibility: str = setting(choices=RESPONSIBILITIES)
    reckless: float | None = setting(low=0, high=1, optional=True)

    def __post_init__(self) -> None:
        if self.eta is not None and not self.eta[0] <= self.eta[1]:
            raise InputError(
                f"learner.react.eta={list(self.eta)}: expected the lowest and the highest intensity"
            )


def drawn(
    settings: ReactSettings,
    eta: Tensor,
    template: Tensor,
    owes: Tensor,
    adversaries: Tensor,
    horizon: int,
    generator: torch.Generator,
) -> TensorDict:
    """The part of the traffic in b new episodes of `horizon` steps, of attacks of eta
    [b] (0: none), template [b], owes [b] bool (they yield to the ego) and adversaries
    [b, V].

    start [b]: step from which on vehicles react (NEVER: they do not), eta [b], count
    [b] of them, others [b] bool: not the traffic's own adversaries; reckless [b] bool:
    they owe the ego nothing; rank [b, V]: random, the lowest react; adversaries [b, V];
    vehicle [b, MOST] and acts [b, MOST]: who they are, nobody yet; chosen [b].
    """
    size = adversaries.shape
    device = adversaries.device
    draws = torch.rand(size[0], 6 + size[1], generator=generator).to(device)
    reacts, others, when, how, many, reckless = draws[:, :6].unbind(1)
    start = (when * LATEST * horizon).long()
    count = 1 + (many * MOST).long()
    if settings.eta is None:
        count = torch.where(template == SINGLE, 1, MOST)
    else:
        low, high = settings.eta
        eta = torch.where(eta > 0, low + (high - low) * how, 0.0)
    nobody = torch.zeros(size[0], MOST, dtype=torch.int64, device=device)
    part = {
        "start": torch.where((eta > 0) & (reacts < settings.fraction), start, NEVER),
        "eta": eta,
        "count": count,
        "others": others < settings.others,
        "reckless": ~owes
        if settings.reckless is None
        else reckless < settings.reckless,
        "rank": draws[:, 6:],
        "adversaries": adversaries,
        "vehicle": nobody,
        "acts": nobody.bool(),
        "chosen": torch.zeros_like(start, dtype=torch.bool),
    }
    return TensorDict(part, batch_size=size[:1], device=device)


def chosen(
    part: TensorDict, world: World, responsibility: str
) -> tuple[Tensor, Tensor]:
    """Vehicles [b, MOST] that begin to react now and which of them there are [b, MOST]:
    present adversaries of the traffic, or others that move near the ego; with full
    responsibility none of these that lead the ego."""
    vehicles = part["rank"].shape[1]
    states = world.states[:, :vehicles]
    present = world.valid[:, :vehicles].clone()
    present[:, 0] = False
    near = (states[..., :2] - world.states[:, :1, :2]).norm(dim=-1) < NEAR
    own = present & part["adversaries"]
    others = present & near & (states[..., 3] > MOVING)
    if responsibility == "full":
        others &= ~leading(world, vehicles)
    others &= ~part["adversaries"]
    first = torch.where((part["others"] & others.any(1))[:, None], others, own)
    first = torch.where(first.any(1)[:, None], first, others)
    found = (
        part["rank"]
        .masked_fill(~first, torch.inf)
        .topk(min(MOST, vehicles), largest=False)
    )
    taken = (
        torch.arange(found.values.shape[1], device=states.device)
        < part["count"][:, None]
    )
    return found.indices, taken & (found.values < torch.inf)


class Reaiming:
    """Vehicles of replayed adversarial episodes that re-aim, as the settings say; draws
    from a generator of its own."""

    def __init__(self, settings: ReactSettings, seed: int = 0) -> None:
        self.settings = settings
        self.generator = torch.Generator().manual_seed(seed)
        self.limits = InterceptionSettings()
        self.yielding = YieldingSettings()
        self.bounds = BoundSettings()
        self._part: TensorDict | None = None  # [B] `drawn`

    def begin(
        self,
        rows: Tensor,
        eta: Tensor,
        template: Tensor,
        owes: Tensor,
        adversaries: Tensor,
        horizon: int,
    ) -> None:
        """Draws for new episodes of environments rows [b] whether, who and when.

        eta [b]: of replayed attacks, 0 of other traffic; template [b], owes [b] bool,
        adversaries [b, V] bool: of these attacks.
        """
        part = drawn(
            self.settings,
            eta,
            template=template,
            owes=owes,
            adversaries=adversaries,
            horizon=horizon,
            generator=self.generator,
        )
        if self._part is None or len(part) == len(self._part):
            self._part = part  # the first reset is of all environments
        else:
            self._part[rows] = part

    @torch.no_grad()
    def react(self, world: World) -> tuple[Tensor, Tensor, Tensor] | None:
        """Environments rows [K], agents [K] and their states [K, H, 4] of the coming 1
        s; None where none reacts."""
        part = self._part
        assert part is not None
        due = ~part["chosen"] & (part["start"] <= world.step)
        if bool(due.any()):
            vehicle, acts = chosen(
                part, world, responsibility=self.settings.responsibility
            )
            part["vehicle"] = torch.where(due[:, None], vehicle, part["vehicle"])
            part["acts"] = part["acts"] | (acts & due[:, None])
            part["chosen"] = part["chosen"] | due
        row, slot = part["acts"].nonzero(as_tuple=True)
        if not len(row):
            return None
        agents = part["vehicle"][row, slot]
        shift = self.settings.scatter * torch.randn(
            len(row), 2, generator=self.generator
        ).to(row.device)
        ground = Ground(world.scene["field"], world.scene["field_origin"], row=row)
        seen = surroundings(world, row, agents=agents)
        aim = self.aims(
            seen,
            part["eta"][row],
            shift=shift,
            ground=ground,
            reckless=part["reckless"][row],
        )
        times = DT * torch.arange(1, 2 * REPLAN_STEPS + 1, device=row.device)
        states, _ = along_arc(seen.states[:, 1], aim, times=times)
        return row, agents, states

    def aims(
        self, world: World, eta: Tensor, shift: Tensor, ground: Ground, reckless: Tensor
    ) -> Arc:
        """The Arc of K vehicles in their `surroundings` at intensities eta [K].

        shift [K, 2]: m by which they misjudge the ego's place; reckless [K] bool: those
        that owe it nothing. Without an aim they halve their curvature and brake gently.
        """
        states = world.states[:, 1]
        length = world.scene["size"][..., 0]
        motion = Arc(world.accel, curvature_of(world.turn_rate, world.states[..., 3]))
        its_motion = Arc(*(value[:, 0] for value in motion))
        expected, _ = along_arc(
            world.states[:, 0], its_motion, times=moments(states), hold=HOLD, turn=TURN
        )
        expected = expected + torch.nn.functional.pad(shift, (0, 2))[:, None]
        aim = best_aim(
            states,
            expected,
            lengths=length[:, 0] + length[:, 1],
            eta=eta,
            ground=ground,
            limits=self.limits,
        )
        none = aim.accel.isnan()
        aim = Arc(
            aim.accel.masked_fill(none, -UNAIMED),
            torch.where(none, motion.curvature[:, 1] / 2, aim.curvature),
        )
        itself = torch.tensor([[False, True]], device=eta.device).expand(len(eta), -1)
        duty = duty_of(
            self.settings.responsibility,
            self.yielding,
            world=world,
            coalition=itself,
            eta=eta,
        )
        duty = Duty(
            duty.exempt[:, 1:] | reckless[:, None],
            duty.yields[:, 1:],
            patience=duty.patience[:, 1:],
        )
        braking = braking_for(world, aim, motion=motion, duty=duty, bounds=self.bounds)
        return aim._replace(
            accel=torch.minimum(aim.accel, (-braking).clamp(min=self.bounds.floor))
        )
