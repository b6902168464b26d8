"""Work over processes: order, errors, and children that die."""

import os
import time

import pytest
import torch

from e2rl.run.errors import InputError
from e2rl.run.processes import in_processes, workers


def square(job):
    return {"value": torch.full((3,), float(job)) ** 2, "process": os.getpid()}


def test_results_keep_the_order_of_the_jobs_whoever_does_them():
    outcome = list(in_processes(square, range(7), processes=3, cost=float))
    assert [result["value"][0].item() for result in outcome] == [
        float(k**2) for k in range(7)
    ]
    assert os.getpid() not in {result["process"] for result in outcome}


@pytest.mark.parametrize(("jobs", "processes"), [(range(3), 1), ([5], 4)])
def test_one_process_or_one_job_stays_here(jobs, processes):
    assert {
        result["process"]
        for result in in_processes(square, jobs, processes=processes, cost=float)
    } == {os.getpid()}


def linger(job):
    if job == 0:
        time.sleep(2.0)
    return job


def test_jobs_are_reported_when_they_end_not_when_their_turn_comes():
    """While the first job lingers in one process, the other does the rest."""
    reported = []
    results = in_processes(
        linger, range(6), processes=2, cost=lambda job: -job, ended=reported.append
    )
    assert next(results) == 0
    assert set(reported) >= {1, 2, 3, 4, 5}
    assert list(results) == [1, 2, 3, 4, 5]
    assert sorted(reported) == list(range(6))
    assert (
        list(
            in_processes(linger, [1, 2], processes=1, cost=float, ended=reported.append)
        )
        == reported[-2:]
        == [1, 2]
    )


def test_jobs_that_come_later_are_done_while_another_lasts():
    """The first job lingers in one process; the other does those that follow."""
    with workers(linger, 2) as crew:
        crew.submit(0, cost=1.0)
        for job in (1, 2, 3):
            number = crew.submit(job, cost=1.0)
            assert crew.result() == (number, job)
        assert crew.result() == (0, 0)


def begun(job):
    began = time.monotonic()
    time.sleep(0.3)
    return began


def test_jobs_of_greatest_cost_begin_first():
    with workers(begun, 2) as crew:
        costs = [5.0, 4.0, 1.0, 2.0, 3.0]  # the first two begin at once
        numbers = {crew.submit(0, cost): cost for cost in costs}
        began = dict(crew.result() for _ in costs)
    order = sorted(numbers, key=began.__getitem__)
    assert {numbers[number] for number in order[2:4]} == {3.0, 2.0}
    assert numbers[order[4]] == 1.0


def refuse(job):
    raise InputError(f"job {job}: refused")


def test_errors_of_the_children_arrive():
    with pytest.raises(InputError, match="refused"):
        list(in_processes(refuse, range(4), processes=2, cost=float))


def vanish(job):
    os._exit(9)


def test_a_child_that_dies_is_named():
    with pytest.raises(InputError, match="processes=2"):
        list(in_processes(vanish, range(4), processes=2, cost=float))
