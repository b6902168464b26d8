"""Ray workers (extra `ray`): what processes here give, bit for bit, though a worker is
killed; one clear message."""

import os
import signal
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from e2rl.scripts.train import train_round

from e2rl.evaluation.protocol import Method, Setup, run_protocol
from e2rl.learning.rounds.attack import make_traffic
from e2rl.planners.idm_planner import IDMEgo
from e2rl.run import ray_workers
from e2rl.run.errors import InputError
from e2rl.run.parts import Parts
from e2rl.run.processes import in_processes
from e2rl.run.ray_workers import RayWorkers
from e2rl.sim.env import SimSettings
from e2rl.sim.rollout_file import ROLLOUTS
from e2rl.traffic.rollout import synthesize_traffic
from tests.evaluation.test_budget import found, known, plan_of, setup_of
from tests.evaluation.test_protocol import SEEDS, same_runs
from tests.learning.small import Ambush, small_run, small_scenes
from tests.traffic.e2.traffic_scenes import scenes, synthesizer

HERE = find_spec("ray") is not None
needs_ray = pytest.mark.skipif(not HERE, reason="Ray is not installed")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def workers():
    """Two workers on this machine."""
    found = RayWorkers(2)
    before = signal.getsignal(signal.SIGTERM)
    ray = found.connect()
    assert signal.getsignal(signal.SIGTERM) is before, (
        "a command still ends as e2rl.run.endings says"
    )
    yield found
    ray.shutdown()


class Mortal(Setup):
    """A setup whose worker is killed once, after it has written the rollouts of a
    batch; mark: the file of that."""

    mark = ""

    def score(self, method, tasks, folder=None, begins=False):
        found = super().score(method, tasks, folder, begins)
        if (
            method.name == "e2"
            and tasks[0][:2] == (2, 1)
            and not os.path.exists(self.mark)
        ):
            with open(self.mark, "w") as file:
                file.write(str(os.getpid()))
            os.kill(os.getpid(), signal.SIGKILL)
        return found


@needs_ray
def test_two_workers_one_killed_on_the_way_give_what_two_processes_give(
    tmp_path, workers
):
    """Nothing is lost, nothing twice: rollouts, rows and metrics, bit for bit."""
    scene_set = scenes(3, steps=20)
    folders = (tmp_path / "forked", tmp_path / "ray")
    for processes, folder in zip((2, workers), folders, strict=True):
        setup = Mortal(scene_set, IDMEgo(), ego_name="idm", sim=SimSettings(), batch=1)
        setup.mark = str(tmp_path / "killed")
        if processes == 2:
            setup.mark = os.devnull  # it is there: nobody is killed
        methods = [
            Method("nominal", synthesizer(), eta=0.0),
            Method("e2", synthesizer(), eta=3.0),
        ]
        run_protocol(
            setup,
            methods,
            seeds=SEEDS,
            folder=folder,
            processes=processes,
            parts=Parts(folder),
        )
    assert int((tmp_path / "killed").read_text()) != os.getpid()
    same_runs(*folders)
    parts = [
        sorted(path.name for path in (folder / "parts").iterdir()) for folder in folders
    ]
    assert parts[0] == parts[1] and len(parts[0]) == 2 * 3 * len(SEEDS)
    for path in (folders[0] / ROLLOUTS).iterdir():
        one = np.load(path)
        other = np.load(folders[1] / ROLLOUTS / path.name)
        assert all(np.array_equal(one[key], other[key]) for key in one.files), path.name


@needs_ray
def test_a_search_on_workers_is_that_of_one_process(workers):
    setup = setup_of()
    plan = plan_of()
    assert known(found(setup, plan, processes=workers)) == known(found(setup, plan))


@needs_ray
def test_workers_make_the_traffic_of_a_round_while_it_learns(workers):
    """The same D' as of the same order here, made against the policy before learning."""
    scene_set = small_scenes()
    run = small_run(scenes=scene_set, nominal="prior", spread=0.5, prefetch=True)
    run.synthesize = synthesize_traffic(scene_set, Ambush(), sim=SimSettings())
    run.batch = 2
    run.workers = workers
    train_round(run)
    order = run._next
    expected, _ = make_traffic(order, run.synthesize, batch=2)
    train_round(run)
    found = run.memory.rounds[-1].traffic
    assert (
        set(found) == set(expected)
        and order.number == run.memory.rounds[-1].number == 1
    )
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def refuse(job):
    raise InputError(f"job {job}: refused")


def vanish(job):
    os._exit(9)


@needs_ray
def test_errors_of_workers_arrive_and_one_that_always_dies_is_named(
    workers, monkeypatch
):
    monkeypatch.setattr(ray_workers, "RETRIES", 1)
    for fault, message in (
        (refuse, "^job 0: refused$"),
        (vanish, "launcher=ray: a job lost its worker 2 times"),
    ):
        with pytest.raises(InputError, match=message):
            list(in_processes(fault, range(1), processes=workers, cost=float))


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(ray_workers, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"launcher=ray: .*\[ray\]"):
        RayWorkers()
