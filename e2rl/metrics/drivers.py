"""Four drivers who meet one other vehicle: UN R157's human driver, UN R157's limit, RSS
and FSM (docs/reference/verdicts.md).

Each driver is a NamedTuple of parameters with `step(state, observation)`, which returns
the next state (the first is `no_conflict`) and the longitudinal acceleration [...]
m/s^2 for the coming step of DT, 0 where the driver does not react. All tensors share
their leading dimensions [...].
"""

from typing import NamedTuple

import torch
from torch import Tensor

from e2rl.scenes.recording import DT

# UN R157, Annex 4, Appendix 3: the competent and careful human driver.
REACTION = 0.75  # s, from the end of the perception to the first braking
FULL_BRAKING = 7.59  # m/s^2: 0.774 g
MAX_JERK = 12.65  # m/s^3: 0.774 g after 0.6 s
CRITICAL_TIME = 2.0  # s, time to collision below which there is a danger
# UN R157, paragraph 5.2.5.2: cut-ins that an automated system has to survive.
LIMIT_DELAY = 0.35  # s
LIMIT_BRAKING = 6.0  # m/s^2
LIMIT_INTRUSION = 0.5  # m between the sides: the other is 0.3 m beyond the lane marking
# The reference study's programs.
EASING = 0.4  # m/s^2, of a driver who has released the pedal
WANDERING_GAP = 1.225  # m between the sides: vehicles 1.6 m apart, 0.375 m of wandering
GAP_TOLERANCE = 1e-4  # m, decides equality in the time to collision


class Observation(NamedTuple):
    """What a driver sees at one step, each field [...]: itself and the other vehicle,
    along and across its own path."""

    speed: Tensor  # m/s, the ego's
    acceleration: Tensor  # m/s^2, the ego's in the step before
    gap: Tensor  # m, ego's front to other's rear; < 0: side by side; inf: nobody
    other_speed: Tensor  # m/s, along the ego's path
    lateral_gap: Tensor  # m, between the facing sides; at most 0: lateral overlap
    lateral_speed: Tensor  # m/s, the other's towards the ego's lane
    length: Tensor  # m, the ego's
    other_length: Tensor  # m, along the ego's path

    @property
    def closing(self) -> Tensor:
        """Speed [...] m/s at which the ego gains on the other."""
        return self.speed - self.other_speed

    @property
    def overlaps(self) -> Tensor:
        """Whether [...] the two overlap laterally."""
        return self.lateral_gap <= 0

    @property
    def other_is_ahead(self) -> Tensor:
        """Whether [...] the other's front is ahead of the ego's."""
        return self.gap > -self.other_length

    @property
    def resolved(self) -> Tensor:
        """Whether [...] the ego has passed the other's front, or is behind it and does
        not gain, or is alone."""
        no_gain = (self.closing <= 0) & (self.gap > 0)
        return ~self.other_is_ahead | no_gain | (self.gap == torch.inf)


class DriverState(NamedTuple):
    """What a driver remembers, each field [...]."""

    risk_time: Tensor  # s, from the perception of the risk on; -1: there is none
    braking: Tensor  # m/s^2, commanded in the step before
    decided: Tensor  # bool, whether `RegulationLimit` has judged this conflict


def no_conflict(like: Tensor) -> DriverState:
    """State of a driver without a conflict, of the shape, dtype and device of `like`
    [...]."""
    return DriverState(
        risk_time=torch.full_like(like, -1),
        braking=torch.zeros_like(like),
        decided=torch.zeros_like(like, dtype=torch.bool),
    )


def next_risk_time(state: DriverState, perceived: Tensor) -> Tensor:
    """Time [...] s from the perception on: counted on where it runs, 0 where the risk
    is perceived in this step, else -1."""
    time = state.risk_time
    return torch.where(time >= 0, time + DT, perceived.to(time.dtype) - 1)


class HumanDriver(NamedTuple):
    """The careful and competent human driver of UN R157 (Annex 4, Appendix 3), as the
    reference study runs it.

    The driver perceives a risk when the other's side is within `perception_gap` and the
    time to collision falls to `time_to_collision` by the end of the step; it releases
    the pedal for `delay`, then brakes ever harder. At high closing speeds, for which
    this time is too short, it perceives the risk when it needs the way that is left.
    """

    perception_gap: float = 0.0  # m between the sides
    time_to_collision: float = CRITICAL_TIME
    delay: float = REACTION
    release: float = EASING
    braking: float = FULL_BRAKING
    jerk: float = MAX_JERK

    def stopping_gap(self, closing: Tensor) -> Tensor:
        """Gap [...] m that the driver needs from perception on to lose a closing speed
        [...] m/s."""
        speed = closing.clamp(min=0)
        build_up = self.braking / (2 * self.jerk)
        return speed * (self.delay + build_up) + speed.square() / (2 * self.braking)

    def step(
        self,
        state: DriverState,
        observation: Observation,
    ) -> tuple[DriverState, Tensor]:
        """Next state and acceleration."""
        gap = observation.gap
        closing = observation.closing
        intrudes = observation.lateral_gap <= self.perception_gap
        needed = torch.maximum(
            closing * self.time_to_collision, self.stopping_gap(closing)
        )
        within = gap <= needed + closing * DT + GAP_TOLERANCE
        risk = intrudes & (closing > 0) & (gap > 0) & within
        over = ~intrudes | observation.resolved
        time = next_risk_time(state, risk).masked_fill(over, -1)
        rising = (state.braking + self.jerk * DT).clamp(max=self.braking)
        eased = self.release * (time >= 0).to(time)
        braking = torch.where(time >= self.delay, rising, eased)
        return DriverState(
            time,
            braking,
            decided=state.decided,
        ), -braking


class RegulationLimit(NamedTuple):
    """The limit of UN R157 5.2.5.2: what an automated system must survive, as the
    reference study runs it.

    A cut-in counts as survivable if TTC > closing speed / (2 braking) + delay when the
    other intrudes into the lane. The driver releases the pedal when the other leaves
    its wandering zone, judges once at the intrusion, and brakes fully after `delay +
    lag` if the cut-in is survivable. If it is not, the driver does nothing.
    """

    release_gap: float = WANDERING_GAP
    release: float = EASING
    intrusion_gap: float = LIMIT_INTRUSION
    delay: float = LIMIT_DELAY
    lag: float = DT  # s, what the study's program takes longer
    braking: float = LIMIT_BRAKING

    def step(
        self,
        state: DriverState,
        observation: Observation,
    ) -> tuple[DriverState, Tensor]:
        """Next state and acceleration."""
        gap = observation.gap
        closing = observation.closing
        over = observation.resolved | (observation.lateral_gap > self.intrusion_gap)
        needed = closing * (closing / (2 * self.braking) + self.delay)
        survivable = (gap > 0) & (gap > needed)
        time = next_risk_time(state, survivable & ~state.decided).masked_fill(over, -1)
        decided = ~over
        leaves_its_lane = (observation.lateral_gap <= self.release_gap) & (
            observation.lateral_speed > 0
        )
        eases = leaves_its_lane & (closing > 0) & (gap > 0) & ~decided
        braking = torch.where(
            time >= self.delay + self.lag,
            self.braking,
            self.release * eases.to(time),
        )
        return DriverState(
            time,
            braking,
            decided=decided,
        ), -braking


class ResponsibilitySensitiveSafety(NamedTuple):
    """RSS (Shalev-Shwartz et al. 2017): brakes while the other is nearer than both safe
    distances.

    Longitudinal: v r + a r^2 / 2 + (v + a r)^2 / (2 b) - u^2 / (2 b_front). Lateral,
    for the other's lateral speed w: margin + (2 w + a r) r / 2 + (w + a r)^2 / (2 b),
    with lateral a and b. r is the response time.
    """

    response: float = REACTION
    acceleration: float = 3.0  # m/s^2, the ego's most during the response
    braking: float = FULL_BRAKING
    front_braking: float = FULL_BRAKING  # the most that the other may brake
    jerk: float = MAX_JERK
    lateral_margin: float = 0.3  # m
    lateral_acceleration: float = 1.0  # m/s^2
    lateral_braking: float = 1.0  # m/s^2

    def safe_distance(self, speed: Tensor, other_speed: Tensor) -> Tensor:
        """Longitudinal safe distance [...] m of an ego behind a vehicle that drives the
        same way."""
        fastest = speed + self.acceleration * self.response
        way = (speed + fastest) / 2 * self.response
        way = way + fastest.square() / (2 * self.braking)
        other_way = other_speed.clamp(min=0).square() / (2 * self.front_braking)
        return (way - other_way).clamp(min=0)

    def safe_lateral_distance(self, lateral_speed: Tensor) -> Tensor:
        """Safe distance [...] m between the sides, for the other's speed towards the
        ego."""
        fastest = lateral_speed + self.lateral_acceleration * self.response
        way = (lateral_speed + fastest) / 2 * self.response
        way = way + fastest.clamp(min=0).square() / (2 * self.lateral_braking)
        return self.lateral_margin + way.clamp(min=0)

    def step(
        self,
        state: DriverState,
        observation: Observation,
    ) -> tuple[DriverState, Tensor]:
        """Next state and acceleration."""
        danger = (
            (
                observation.lateral_gap
                < self.safe_lateral_distance(observation.lateral_speed)
            )
            & observation.other_is_ahead
            & (
                observation.gap
                < self.safe_distance(observation.speed, observation.other_speed)
            )
        )
        time = next_risk_time(state, danger).masked_fill(~danger, -1)
        rising = (state.braking + self.jerk * DT).clamp(max=self.braking)
        braking = rising * (time >= self.response)
        return DriverState(
            time,
            braking,
            decided=state.decided,
        ), -braking


class FuzzySafetyModel(NamedTuple):
    """FSM (Mattas et al. 2020; UN R157, Annex 3): anticipates, and brakes as hard as
    two fuzzy metrics ask.

    Its lateral check holds where the other overlaps, or comes over before the ego has
    passed it (`lateral_margin` s to spare). Then the proactive and the critical metric,
    each 0 (safe) to 1 (unsafe), set the braking after `reaction`.
    """

    reaction: float = REACTION
    comfortable_braking: float = 4.0  # m/s^2
    braking: float = 6.0  # m/s^2
    front_braking: float = 7.0  # m/s^2, the most that the other may brake
    margin: float = 2.0  # m, at standstill
    safe_margin: float = 2.0  # m, more than that to be safe
    jerk: float = MAX_JERK
    lateral_margin: float = 0.1  # s

    def proactive(self, gap: Tensor, speed: Tensor, other_speed: Tensor) -> Tensor:
        """PFS [...]: what if the other brakes fully at once."""
        other_way = other_speed.clamp(min=0).square() / (2 * self.front_braking)
        free = speed * self.reaction - other_way
        unsafe = free + speed.square() / (2 * self.braking)
        safe = free + speed.square() / (2 * self.comfortable_braking) + self.safe_margin
        return ((safe + self.margin - gap) / (safe - unsafe)).clamp(0, 1)

    def critical(
        self,
        gap: Tensor,
        speed: Tensor,
        *,
        acceleration: Tensor,
        other_speed: Tensor,
    ) -> Tensor:
        """CFS [...]: what if the other keeps its speed.

        Args:
            gap: [...] m.
            speed: [...] m/s, the ego's.
            acceleration: [...] m/s^2, the ego's.
            other_speed: [...] m/s.
        """
        acceleration = acceleration.clamp(min=-self.comfortable_braking)
        after = speed + acceleration * self.reaction - other_speed
        way = (speed + acceleration * self.reaction / 2 - other_speed) * self.reaction
        unsafe = way + after.square() / (2 * self.braking)
        safe = way + after.square() / (2 * self.comfortable_braking)
        fuzzy = ((safe - gap) / (safe - unsafe)).clamp(0, 1)
        # Where the present braking already suffices, the way until both are equally
        # fast decides.
        closing = speed - other_speed
        way = closing.square() / (-2 * acceleration).clamp(min=1e-6)
        sharp = (gap < way).to(gap.dtype)
        return torch.where(after > 0, fuzzy, sharp) * (closing > 0)

    def step(
        self,
        state: DriverState,
        observation: Observation,
    ) -> tuple[DriverState, Tensor]:
        """Next state and acceleration."""
        gap = observation.gap
        speed = observation.speed
        closing = observation.closing
        way = gap + observation.length + observation.other_length
        passing_time = way / closing + self.lateral_margin
        comes_over = (
            (observation.lateral_speed > 0)
            & (closing > 0)
            & (observation.lateral_gap < passing_time * observation.lateral_speed)
        )
        concerns = (observation.overlaps | comes_over) & observation.other_is_ahead
        other_speed = observation.other_speed
        critical = self.critical(
            gap,
            speed,
            acceleration=observation.acceleration,
            other_speed=other_speed,
        )
        comfortable = self.comfortable_braking
        hard = comfortable + (self.braking - comfortable) * critical
        soft = comfortable * self.proactive(
            gap,
            speed,
            other_speed=other_speed,
        )
        wanted = torch.where(critical > 0, hard, soft) * concerns
        time = next_risk_time(state, wanted > 0).masked_fill(wanted <= 0, -1)
        rising = torch.minimum(wanted, state.braking + self.jerk * DT)
        braking = rising * (time >= self.reaction)
        return DriverState(
            time,
            braking,
            decided=state.decided,
        ), -braking


Driver = (
    HumanDriver | RegulationLimit | ResponsibilitySensitiveSafety | FuzzySafetyModel
)
DRIVERS: dict[str, Driver] = {
    "human": HumanDriver(),
    "regulation": RegulationLimit(),
    "rss": ResponsibilitySensitiveSafety(),
    "fsm": FuzzySafetyModel(),
}
