"""Constant velocity from the causal start states."""

from torch import Tensor

from e2rl.sim.world import World
from e2rl.traffic.traffic import State, Traffic, TrafficPlan, keep_velocity, steps_ahead


class ConstantVelocity(Traffic):
    """Start heading and start speed are kept; parked vehicles stay parked, and no vehicle leaves."""

    stochastic = False

    def replan(self, state: State, world: World, ego_plan: Tensor) -> tuple[State, TrafficPlan]:
        """States at the coming steps, from the start frame on."""
        scene, vehicles = world.scene, world.scene["route_log"].shape[1]
        start = scene["start"][:, :vehicles].clone()
        start[..., 3] = start[..., 3].masked_fill(scene["parked"][:, :vehicles], 0.0)
        states = keep_velocity(start, steps_ahead(world)[:, None])
        return state, TrafficPlan(states, world.valid[:, :vehicles, None].expand(states.shape[:-1]))
