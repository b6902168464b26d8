"""Four drivers who meet one other vehicle: R157's human driver, R157's limit, RSS and
FSM (docs/verdicts.md).

Each driver is a NamedTuple of parameters with `step(state, observation)`, which gives
the next state (at first `no_conflict`) and the longitudinal acceleration [...] m/s^2
for the coming step of DT, 0 where the driver does not react. All tensors share their
leading dimensions [...].
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.scenes.recording import DT

GAP_TOLERANCE = 1e-4  # m, decides equality in the time to collision
MAX_JERK = 12.65  # m/s^3, at which brakes build up


class Observation(NamedTuple):
    """What a driver sees at one step, each field [...]: itself and the other vehicle,
    along and across its own path."""

    speed: Tensor  # m/s, the ego's
    acceleration: Tensor  # m/s^2, the ego's in the step before
    gap: Tensor  # m, from the ego's front to the other's rear; negative: side by side; inf: there is no other
    other_speed: Tensor  # m/s, along the ego's way
    lateral_gap: (
        Tensor  # m, between the facing sides; at most 0: they overlap laterally
    )
    lateral_speed: Tensor  # m/s, the other's towards the ego's lane
    overlaps: Tensor  # bool, whether they overlap laterally
    length: Tensor  # m, the ego's
    other_length: Tensor  # m, along the ego's way

    @property
    def closing(self) -> Tensor:
        """Speed [...] m/s at which the ego gains on the other."""
        return self.speed - self.other_speed

    @property
    def other_is_ahead(self) -> Tensor:
        """Whether [...] the other's front is ahead of the ego's."""
        return self.gap > -self.other_length

    @property
    def resolved(self) -> Tensor:
        """Whether [...] the ego has passed the other's front, or is behind it and does
        not gain, or is alone."""
        return (
            ~self.other_is_ahead
            | ((self.closing <= 0) & (self.gap > 0))
            | (self.gap == torch.inf)
        )


class DriverState(NamedTuple):
    """What a driver remembers, each field [...]."""

    since: Tensor  # s since the driver has perceived the risk; -1: there is none
    braking: Tensor  # m/s^2, commanded in the step before
    decided: Tensor  # bool, whether `RegulationLimit` has judged this conflict


def no_conflict(like: Tensor) -> DriverState:
    """State of a driver without a conflict, of the shape, dtype and device of `like`
    [...]."""
    return DriverState(
        torch.full_like(like, -1),
        torch.zeros_like(like),
        decided=torch.zeros_like(like, dtype=torch.bool),
    )


def elapsed(since: Tensor, perceived: Tensor) -> Tensor:
    """Time [...] s since the perception: counted on where it runs, 0 where the risk is
    perceived now, else -1."""
    return torch.where(since >= 0, since + DT, perceived.to(since.dtype) - 1)


class HumanDriver(NamedTuple):
    """The careful and competent human driver of UN R157 (Annex 4, Appendix 3), as the
    reference study runs it.

    The driver perceives a risk when the other's side is within `perception_gap` and the
    time to collision falls to `time_to_collision` by the end of the step; it releases
    the pedal for `delay`, then brakes ever harder. At high closing speeds, for which
    this time is too short, it perceives the risk when it needs the way that is left.
    """

    perception_gap: float = 0.0  # m, between the sides; 1.225: the other leaves its wandering zone on 3.5 m lanes
    time_to_collision: float = 2.0  # s
    delay: float = 0.75  # s
    release: float = 0.4  # m/s^2
    braking: float = 7.59  # m/s^2, 0.774 g
    jerk: float = MAX_JERK

    def stopping_gap(self, closing: Tensor) -> Tensor:
        """Gap [...] m that the driver needs from perception on to lose a closing speed
        [...] m/s."""
        speed = closing.clamp(min=0)
        return speed * (
            self.delay + self.braking / (2 * self.jerk)
        ) + speed.square() / (2 * self.braking)

    def step(
        self, state: DriverState, observation: Observation
    ) -> tuple[DriverState, Tensor]:
        o = observation
        intrudes = o.overlaps | (o.lateral_gap <= self.perception_gap)
        needed = torch.maximum(
            o.closing * self.time_to_collision, self.stopping_gap(o.closing)
        )
        reach = needed + o.closing * DT + GAP_TOLERANCE
        risk = intrudes & (o.closing > 0) & (o.gap > 0) & (o.gap <= reach)
        since = elapsed(state.since, risk).masked_fill(~intrudes | o.resolved, -1)
        rising = (state.braking + self.jerk * DT).clamp(max=self.braking)
        braking = torch.where(
            since >= self.delay, rising, self.release * (since >= 0).to(since)
        )
        return DriverState(since, braking, decided=state.decided), -braking


class RegulationLimit(NamedTuple):
    """The limit of UN R157 5.2.5.2: what an automated system must survive, as the
    reference study runs it.

    A cut-in counts as survivable if TTC > closing speed / (2 braking) + delay when the
    other intrudes into the lane. The driver releases the pedal when the other leaves
    its wandering zone, judges once at the intrusion, and brakes fully after `delay +
    lag` if the cut-in is survivable. If it is not, the driver does nothing.
    """

    release_gap: float = (
        1.225  # m between the sides: vehicles 1.6 m apart, 0.375 m of wandering
    )
    release: float = 0.4  # m/s^2
    intrusion_gap: float = 0.5  # m between the sides: 0.3 m past the marking
    delay: float = 0.35  # s
    lag: float = DT  # s, what the study's program takes longer
    braking: float = 6.0  # m/s^2

    def step(
        self, state: DriverState, observation: Observation
    ) -> tuple[DriverState, Tensor]:
        o = observation
        intrudes = o.overlaps | (o.lateral_gap <= self.intrusion_gap)
        over = o.resolved | ~intrudes
        survivable = (o.gap > 0) & (
            o.gap > o.closing * (o.closing / (2 * self.braking) + self.delay)
        )
        since = elapsed(state.since, survivable & ~state.decided).masked_fill(over, -1)
        decided = ~over
        enters = (
            (o.lateral_gap <= self.release_gap)
            & (o.lateral_speed > 0)
            & (o.closing > 0)
            & (o.gap > 0)
        )
        release = self.release * (enters & ~decided).to(since)
        braking = torch.where(since >= self.delay + self.lag, self.braking, release)
        return DriverState(since, braking, decided=decided), -braking


class ResponsibilitySensitiveSafety(NamedTuple):
    """RSS (Shalev-Shwartz et al. 2017): brakes while the other is nearer than both safe
    distances.

    Longitudinal: v r + a r^2 / 2 + (v + a r)^2 / (2 b) - u^2 / (2 b_front). Lateral,
    for the other's lateral speed w: margin + (2 w + a r) r / 2 + (w + a r)^2 / (2 b),
    with lateral a and b. r is the response time.
    """

    response: float = 0.75  # s
    acceleration: float = (
        3.0  # m/s^2, the most the ego may accelerate during the response
    )
    braking: float = 7.59  # m/s^2
    front_braking: float = 7.59  # m/s^2, the most the other may brake
    jerk: float = MAX_JERK
    lateral_margin: float = 0.3  # m
    lateral_acceleration: float = 1.0  # m/s^2
    lateral_braking: float = 1.0  # m/s^2

    def safe_distance(self, speed: Tensor, other_speed: Tensor) -> Tensor:
        """Longitudinal safe distance [...] m of an ego behind a vehicle that drives the
        same way."""
        fastest = speed + self.acceleration * self.response
        way = (speed + fastest) / 2 * self.response + fastest.square() / (
            2 * self.braking
        )
        return (
            way - other_speed.clamp(min=0).square() / (2 * self.front_braking)
        ).clamp(min=0)

    def safe_lateral_distance(self, lateral_speed: Tensor) -> Tensor:
        """Safe distance [...] m between the sides, for the other's speed towards the
        ego."""
        fastest = lateral_speed + self.lateral_acceleration * self.response
        way = (lateral_speed + fastest) / 2 * self.response
        way = way + fastest.clamp(min=0).square() / (2 * self.lateral_braking)
        return self.lateral_margin + way.clamp(min=0)

    def step(
        self, state: DriverState, observation: Observation
    ) -> tuple[DriverState, Tensor]:
        o = observation
        near = o.overlaps | (
            o.lateral_gap < self.safe_lateral_distance(o.lateral_speed)
        )
        danger = (
            near
            & o.other_is_ahead
            & (o.gap < self.safe_distance(o.speed, o.other_speed))
        )
        since = elapsed(state.since, danger).masked_fill(~danger, -1)
        rising = (state.braking + self.jerk * DT).clamp(max=self.braking)
        braking = rising * (since >= self.response)
        return DriverState(since, braking, decided=state.decided), -braking


class FuzzySafetyModel(NamedTuple):
    """FSM (Mattas et al. 2020; UN R157, Annex 3): anticipates, and brakes as hard as
    two fuzzy metrics ask.

    Its lateral check holds where the other overlaps, or comes over before the ego has
    passed it (`lateral_margin` s to spare). Then the proactive and the critical metric,
    each 0 (safe) to 1 (unsafe), set the braking after `reaction`.
    """

    reaction: float = 0.75  # s
    comfortable_braking: float = 4.0  # m/s^2
    braking: float = 6.0  # m/s^2
    front_braking: float = 7.0  # m/s^2, the most the other may brake
    margin: float = 2.0  # m, kept at standstill
    safe_margin: float = 2.0  # m, more than that to be safe
    jerk: float = MAX_JERK
    lateral_margin: float = 0.1  # s

    def proactive(self, gap: Tensor, speed: Tensor, other_speed: Tensor) -> Tensor:
        """PFS [...]: what if the other brakes fully now."""
        free = speed * self.reaction - other_speed.clamp(min=0).square() / (
            2 * self.front_braking
        )
        unsafe = free + speed.square() / (2 * self.braking)
        safe = free + speed.square() / (2 * self.comfortable_braking) + self.safe_margin
        return ((safe + self.margin - gap) / (safe - unsafe)).clamp(0, 1)

    def critical(
        self, gap: Tensor, speed: Tensor, acceleration: Tensor, other_speed: Tensor
    ) -> Tensor:
        """CFS [...]: what if the other keeps its speed."""
        acceleration = acceleration.clamp(min=-self.comfortable_braking)
        after = speed + acceleration * self.reaction - other_speed
        way = (speed + acceleration * self.reaction / 2 - other_speed) * self.reaction
        unsafe = way + after.square() / (2 * self.braking)
        safe = way + after.square() / (2 * self.comfortable_braking)
        fuzzy = ((safe - gap) / (safe - unsafe)).clamp(0, 1)
        # Where the present braking already suffices, the way until both are equally
        # fast decides.
        closing = speed - other_speed
        sharp = (gap < closing.square() / (-2 * acceleration).clamp(min=1e-6)).to(
            gap.dtype
        )
        return torch.where(after > 0, fuzzy, sharp) * (closing > 0)

    def step(
        self, state: DriverState, observation: Observation
    ) -> tuple[DriverState, Tensor]:
        o = observation
        passing = (o.gap + o.length + o.other_length) / o.closing + self.lateral_margin
        comes_over = (
            (o.lateral_speed > 0)
            & (o.closing > 0)
            & (o.lateral_gap < passing * o.lateral_speed)
        )
        checked = (o.overlaps | comes_over) & o.other_is_ahead
        critical = self.critical(
            o.gap, o.speed, acceleration=o.acceleration, other_speed=o.other_speed
        )
        hard = (
            self.comfortable_braking
            + (self.braking - self.comfortable_braking) * critical
        )
        soft = self.comfortable_braking * self.proactive(
            o.gap, o.speed, other_speed=o.other_speed
        )
        wanted = torch.where(critical > 0, hard, soft) * checked
        since = elapsed(state.since, wanted > 0).masked_fill(wanted <= 0, -1)
        braking = torch.minimum(wanted, state.braking + self.jerk * DT) * (
            since >= self.reaction
        )
        return DriverState(since, braking, decided=state.decided), -braking


Driver = (
    HumanDriver | RegulationLimit | ResponsibilitySensitiveSafety | FuzzySafetyModel
)
DRIVERS: dict[str, Driver] = {
    "human": HumanDriver(),
    "regulation": RegulationLimit(),
    "rss": ResponsibilitySensitiveSafety(),
    "fsm": FuzzySafetyModel(),
}
