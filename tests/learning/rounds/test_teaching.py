"""Teaching: which states are labelled; a label is what the planner would do there;
silence changes nothing."""

import pytest
import torch
from tensordict import TensorDict

from e2rl.learning.pretraining.cloning import clip_expert
from e2rl.learning.rounds.teaching import Teacher, TeachingSettings, critical
from e2rl.planners.actor import ActorEgo
from e2rl.planners.idm_planner import IDMEgo
from e2rl.planners.sampling import SamplingEgo, ranked_actions
from e2rl.run.errors import InputError
from e2rl.sim.env import DrivingEnv
from e2rl.sim.observation import OBSERVATION_SIZE
from e2rl.sim.settings import SimSettings
from e2rl.traffic.pool import TrafficPool
from tests.learning.small import brake_check, small_run, small_scenes

ANY = {
    "near": 1e9,
    "regret": -1e9,
    "survivable": 1e9,
}  # every state of an adversarial episode is labelled


def teacher_of(planner, scenes):
    """A teacher with the settings of the file."""
    return Teacher(
        planner,
        scenes,
        low=torch.tensor([-8.0, -1.6]),
        high=torch.tensor([5.0, 1.6]),
        hold=2,
        settings=TeachingSettings(),
    )


def timeline(contacts, dones, near=(), decisions=30):
    """A batch [1, T] of decisions of 0.2 s with contacts, ends of episodes and near
    misses at these decisions."""
    flags = torch.zeros(3, 1, decisions, 1, dtype=torch.bool)
    for flag, at in zip(flags, (contacts, dones, near), strict=True):
        flag[0, list(at)] = True
    ended = torch.nn.functional.pad(flags[1, 0, :-1, 0].cumsum(0), (1, 0))
    step = torch.stack([2 * (ended[:k] == ended[k]).sum() for k in range(decisions)])
    observation = torch.ones(1, decisions, OBSERVATION_SIZE)
    observation[flags[2, ..., 0], -15:] = 0.5 / 3.7
    metrics = {
        "contact": flags[0],
        **dict.fromkeys(("contact_vru", "contact_object"), torch.zeros_like(flags[0])),
    }
    after = TensorDict({"metrics": metrics, "done": flags[1]}, [1, decisions])
    return TensorDict(
        {"observation": observation, "timestep": step[None, :, None], "next": after},
        [1, decisions],
    )


def labelled(data, **settings):
    return (
        critical(data, **({"window": 1.0, "near": 1.2} | settings))[0]
        .nonzero()[:, 0]
        .tolist()
    )


def test_critical_states_lie_in_the_window_before_contacts_and_near_misses():
    assert labelled(timeline([12], [12])) == list(range(7, 13)), (
        "1 s is 5 decisions before"
    )
    assert labelled(timeline([], [29], near=[12])) == list(range(7, 13))
    assert (
        labelled(timeline([], [29], near=[12]), near=0.4)
        == []
        == labelled(timeline([], [29]))
    )
    assert labelled(timeline([12, 25], [12, 25]), window=0.0) == [12, 25]


def test_critical_states_are_of_the_same_episode():
    """What happens to the next episode in the same environment is no danger to this
    one."""
    assert labelled(timeline([12], [9, 12])) == [10, 11, 12]
    assert labelled(timeline([2], [2, 20], near=[21])) == [0, 1, 2, 21]


def attacked(scenes, eta=1.0):
    index = torch.arange(len(scenes))
    return TrafficPool.stored(brake_check(scenes)(None, index, eta, 0), eta)


def collected(scenes, pool, hold=2, **given):
    """A batch of `small_run`'s policy in the pool, and its learner."""
    expert = {"teacher": SamplingEgo(), "teaching": {**ANY, **given}}
    run = small_run(
        scenes=scenes,
        expert=expert,
        teaching=0.1,
        collect={"hold": hold},
    )
    run.improve.synthesizer.pool = pool
    run.improve.draw.probability = pool.probabilities(torch.ones(len(scenes)), 1.0)
    run.improve._collector.reset()
    return run.improve.collected().clone(), run.improve


def test_a_label_is_what_the_planner_would_do_in_the_same_state():
    """The episodes are driven again from their actions: every state is met bit for bit,
    and there the planner ranks."""
    scenes = small_scenes(3, steps=40)
    pool = attacked(scenes)
    data, improve = collected(scenes, pool)
    index = data["scene_index"][:, 0, 0]
    env = DrivingEnv(
        scenes,
        SimSettings(),
        len(index),
        agents=True,
        hold=2,
    )
    planner = SamplingEgo()
    states, valid = pool.tracks(data["traffic", "row"][:, 0, 0])
    env.set_traffic(torch.arange(len(index)), states, valid)
    env.reset(TensorDict({"scene_index": index[:, None]}, [len(index)]))
    low = env.action_spec.space.low[0]
    high = env.action_spec.space.high[0]
    for step in range(8):
        frames = data[:, step]
        world = env.world()
        for name in ("states", "valid", "accel", "turn_rate"):
            assert torch.equal(frames["agents", name], getattr(world, name)), name
        labels, _ = improve.teacher.labels(frames, improve.ego)
        actions, costs = ranked_actions(
            planner,
            world,
            count=48,
            hold=2,
        )
        assert torch.equal(labels["action"], clip_expert(actions, low, high=high))
        assert torch.equal(labels["weight"], torch.softmax(-costs / 5.0, -1))
        assert torch.equal(labels["observation"], frames["observation"])
        env.step(TensorDict({"action": frames["action"]}, [len(index)]))


class Blind(ActorEgo):
    """A policy that plans to go on at its speed."""

    def plan(self, world):
        time = 0.1 * torch.arange(1, 51)
        states = world.states[:, :1].repeat(1, 50, 1)
        states[..., 0] += states[..., 3] * time
        return states


def test_only_what_the_teacher_does_better_by_far_and_survives_is_labelled():
    """A policy that would run into the leader is corrected, one that plans as the
    teacher is not; nor is anybody where the teacher expects to be hit itself."""
    scenes = small_scenes(3, steps=40)
    data, improve = collected(scenes, attacked(scenes, 3.0))
    start = data[:, 2]  # the leader is there from the first step on
    strict = teacher_of(SamplingEgo(), scenes)
    assert len(strict.labels(start, Blind())[0]) == len(start)
    assert len(strict.labels(start, SamplingEgo())[0]) == 0
    hopeless = start.clone()
    hopeless["agents", "states"][:, 1, :2] = hopeless["agents", "states"][
        :, 0, :2
    ] + torch.tensor([3.0, 0.0])
    assert len(strict.labels(hopeless, Blind())[0]) == 0
    assert len(improve.teacher.labels(hopeless, Blind())[0]) == len(start), (
        "of which all are with these settings"
    )


def test_a_row_is_survivable_where_the_teacher_gets_away_and_the_policy_does_not():
    scenes = small_scenes(3, steps=40)
    pool = attacked(scenes, 3.0)
    data, improve = collected(scenes, pool)
    teacher = improve.teacher
    row = data["traffic", "row"][..., 0].unique()
    teacher.watch(data, pool.adversarial, SamplingEgo(), 1000)
    share = teacher.survivable(len(pool))
    assert (share[row] == 0).all(), (
        "who plans as the teacher does loses nothing that it would survive"
    )
    assert teacher.survivable(len(pool)).isnan().all(), "of a round alone"
    _, away = teacher.labels(data[:, 2], Blind())
    hopeless = data[:, 2].clone()
    hopeless["agents", "states"][:, 1, :2] = hopeless["agents", "states"][
        :, 0, :2
    ] + torch.tensor([3.0, 0.0])
    assert away.all()
    assert not teacher.labels(hopeless, Blind())[1].any()


def test_nominal_episodes_are_not_labelled_and_the_newest_labels_stay():
    scenes = small_scenes(3, steps=40)
    pool = attacked(scenes)
    data, improve = collected(scenes, pool, memory=30)
    teacher = improve.teacher
    ego = improve.ego
    assert teacher.watch(data, torch.zeros(3).bool(), ego, 10) == {
        "critical": 0,
        "labels": 0,
    }
    assert teacher.labelled is None
    assert teacher.watch(data, pool.adversarial, ego, 20) == {
        "critical": data.numel(),
        "labels": 20,
    }
    first = teacher.labelled["observation"].clone()
    teacher.watch(data, pool.adversarial, ego, 20)
    assert torch.equal(teacher.labelled["observation"][:10], first[10:])
    assert len(teacher.labelled) == 30
    of_one = (data["scene_index"] == 1).sum().item()
    assert (
        teacher.watch(data, torch.tensor([False, True, False]), ego, 5)["critical"]
        == of_one
        > 0
    )


def test_what_cannot_teach_is_refused():
    scenes = small_scenes(1)
    with pytest.raises(InputError, match=r"learner\.teacher=.*ScoringEgo"):
        teacher_of(IDMEgo(), scenes)
