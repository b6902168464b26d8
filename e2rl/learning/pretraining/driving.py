"""Drives an ego through one episode per pool row, for demonstrations; outcomes of
episodes."""

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase, tensorclass
from torch import Tensor
from torchrl.envs import TransformedEnv

from e2rl.planners.ego import Ego
from e2rl.planners.ego_policy import EgoPolicy
from e2rl.scenes.recording import DT
from e2rl.scenes.scene import SceneSet
from e2rl.sim.dynamics import wrap
from e2rl.sim.env import METRICS, DrivingEnv, SimSettings, touches
from e2rl.traffic.pool import TrafficPool
from e2rl.traffic.transform import AdversarialSynthesizer

OUTCOME_KEYS = (
    ("traffic", "row"),
    "scene_index",
    *(("next", name) for name in ("timestep", "done", "episode_reward")),
    *(("next", "metrics", name) for name in METRICS),
)


@tensorclass
class Episodes:
    """E finished episodes, each field [E]: pool row and scene (int64), adversarial
    traffic, contact with any agent, off the road (bool), return, progress [m];
    survivable: the fraction of the row's critical moments that a teacher would survive
    (NaN: unknown)."""

    row: Tensor
    scene_index: Tensor
    adversarial: Tensor
    contact: Tensor
    off_road: Tensor
    returns: Tensor
    progress: Tensor
    survivable: Tensor

    @property
    def failed(self) -> Tensor:
        """Bool [E]: ended by contact or off the road."""
        return self.contact | self.off_road

    def summary(self) -> dict[str, float]:
        """Means over all episodes and over those in adversarial and in nominal traffic;
        kinds without any are left out."""
        values = {
            "contact": self.contact.float(),
            "off_road": self.off_road.float(),
            "return": self.returns,
            "progress": self.progress,
        }
        kinds = {
            "": torch.ones_like(self.adversarial),
            "_adversarial": self.adversarial,
            "_nominal": ~self.adversarial,
        }
        result = {"episodes": float(len(self))}
        for suffix, rows in kinds.items():
            for name, value in values.items():
                if rows.any():
                    result[name + suffix] = value[rows].mean().item()
        return result


def decisions(steps, hold: int):
    """Decisions (int or Tensor) in which an episode reaches so many steps; the last may
    be cut short."""
    return (steps + hold - 1) // hold


def finished_episodes(
    batches: list[TensorDictBase], adversarial: Tensor, horizon: int, hold: int = 1
) -> Episodes:
    """Episodes of a round's batches [B, T_i] in order (OUTCOME_KEYS), all environments
    reset at the first frame.

    A frame is a decision, held for `hold` steps; an episode has at most `horizon`
    steps. Episodes that began too late to last so long before the end of the data are
    omitted: only the failures among them would be finished. adversarial [R]: of the
    pool's rows.
    """
    data = TensorDict.cat(
        [batch.select(*OUTCOME_KEYS).to("cpu") for batch in batches], 1
    )
    after = data["next"]
    metrics = data["next", "metrics"]
    begin = torch.arange(data.shape[1]) + 1 - decisions(after["timestep"][..., 0], hold)
    ended = after["done"][..., 0] & (begin + decisions(horizon, hold) <= data.shape[1])
    row = data["traffic", "row"][ended][:, 0]
    contact = touches(metrics)
    return Episodes(
        row,
        data["scene_index"][ended][:, 0],
        adversarial=adversarial[row],
        contact=contact[ended][:, 0],
        off_road=metrics["off_road"][ended][:, 0],
        returns=after["episode_reward"][ended][:, 0],
        progress=metrics["progress"][ended][:, 0],
        survivable=torch.full((len(row),), torch.nan),
        batch_size=[len(row)],
    )


Disturbance = Callable[
    [Tensor, Tensor], Tensor
]  # (action [B, 2], step [B]) -> the action [B, 2] executed instead


class PoolDriver:
    """Environments in which egos drive rows of pools with recorded or stored traffic."""

    def __init__(
        self,
        scenes: SceneSet,
        sim: SimSettings,
        batch: int,
        device: str = "cpu",
        hold: int = 1,
    ) -> None:
        """batch: number of environments, i.e. of rows driven at once; hold: steps of a
        decision."""
        self.env = DrivingEnv(scenes, sim, batch, device, agents=True, hold=hold)

    def drive(
        self,
        ego: Ego,
        pool: TrafficPool,
        rows: Tensor,
        disturb: Disturbance | None = None,
    ) -> TensorDict:
        """One episode of T decisions in each of pool rows [B]; B is the number of
        environments.

        Returns [B, T]: observation, intended (the ego's action), executed (after
        disturbance and bounds) [.., 2], alive (the decision belongs to the episode),
        reward, contact, off_road, progress.
        """
        transform = AdversarialSynthesizer(pool, lambda count: rows[:count])
        env = TransformedEnv(self.env, transform)
        policy = EgoPolicy(ego, env)

        def disturbed(tensordict: TensorDictBase) -> TensorDictBase:
            tensordict = policy(tensordict)
            tensordict["intended"] = intended = tensordict["action"]
            if disturb is not None:
                tensordict["action"] = disturb(intended, tensordict["timestep"][:, 0])
            return tensordict

        length = decisions(self.env.horizon, self.env.hold)
        steps = env.rollout(length, disturbed, break_when_any_done=False)
        after = steps["next"]
        metrics = steps["next", "metrics"]
        done = after["done"][..., 0].int()
        alive = done.cumsum(1) - done == 0
        contact = touches(metrics)[..., 0]
        frames = {
            "observation": steps["observation"],
            "intended": steps["intended"],
            "executed": executed(steps),
            "alive": alive,
            "reward": after["reward"][..., 0] * alive,
            "off_road": metrics["off_road"][..., 0] & alive,
            "contact": contact & alive,
            "progress": metrics["progress"][..., 0],
        }
        return TensorDict(frames, batch_size=steps.batch_size, device=alive.device)


def executed(steps: TensorDictBase) -> Tensor:
    """Mean accelerations and yaw rates [B, T, 2] (m/s^2, rad/s) of the ego over each
    decision of a rollout."""
    now, then = (each["agents", "states"][:, :, 0] for each in (steps, steps["next"]))
    seconds = (steps["next", "timestep"] - steps["timestep"]).clamp(min=1) * DT
    return (
        torch.cat(
            [then[..., 3:] - now[..., 3:], wrap(then[..., 2:3] - now[..., 2:3])], -1
        )
        / seconds
    )


def filled_batches(count: int, batch: int) -> list[Tensor]:
    """Rows 0..count-1 in batches of exactly `batch`, the last one filled up by
    repetition."""
    return (
        list((torch.arange(-(-count // batch) * batch) % count).split(batch))
        if count
        else []
    )
