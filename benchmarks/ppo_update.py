"""One PPO update on a collected batch of the default size."""

from collections.abc import Iterator

from hydra.utils import instantiate
from measure import Bench, Row
from torchrl.collectors import Collector

from e2rl.learning.rounds.update import Learner
from e2rl.planners.actor import ActorEgo
from e2rl.sim.env import DrivingEnv


def ppo_update(bench: Bench) -> Iterator[Row]:
    """Seconds and frames per second of an update."""
    config = bench.configured("train")
    batch = config.learner.collect.batch
    steps = config.learner.collect.steps
    network = ActorEgo().network
    source = Collector(
        DrivingEnv(bench.scenes, bench.sim, batch),
        network.actor,
        frames_per_batch=batch * steps,
        total_frames=batch * steps,
        auto_register_policy_transforms=False,
    )
    data = next(iter(source))
    source.shutdown()
    learner = Learner(
        network,
        instantiate(config.learner.ppo, critic_warmup=0, target_kl=1e9),
    )
    seconds = bench.best(lambda: learner.update(data))
    yield bench.row("ppo_update", "update", bench.pick(batch), seconds, "s")
    yield bench.row(
        "ppo_update", "update", bench.pick(batch), batch * steps / seconds, "frames/s"
    )
