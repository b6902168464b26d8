"""What raises or is not finite loses its own rollouts, however it is found."""

import pytest
import torch
from tensordict import TensorDict

from e2rl.planners.ego_errors import PlannerError
from e2rl.run.errors import InputError
from e2rl.traffic.attempt import NOT_FINITE, attempt


def whole(tasks):
    states = torch.zeros(len(tasks), 1, 1, 4)
    valid = torch.ones(len(tasks), 1, 1, dtype=torch.bool)
    return TensorDict({"states": states, "valid": valid}, [len(tasks)])


def test_states_that_are_not_finite_count_as_ended():
    def roll_out(tasks):
        states = torch.zeros(len(tasks), 2, 3, 4)
        states[:, :, 2] = torch.nan  # of an agent that is not there
        states[1, 1, 0, 3] = torch.inf
        valid = torch.tensor([True, True, False]).expand(len(tasks), 2, 3)
        return TensorDict(
            {"states": states, "valid": valid, "task": torch.tensor(tasks)},
            [len(tasks)],
        )

    ((rest, rollouts),), ended = attempt(roll_out, [4, 5, 6])
    assert rest == [4, 6] == rollouts["task"].tolist()
    assert [(task, why["reason"]) for task, why in ended] == [(5, NOT_FINITE)]


@pytest.mark.parametrize(
    "error", [InputError("bad"), OSError(28, "No space left on device"), MemoryError()]
)
def test_errors_of_the_whole_run_end_it(error):
    def roll_out(tasks):
        raise error

    with pytest.raises(type(error)):
        attempt(roll_out, [1, 2])


@pytest.mark.parametrize(
    "error",
    [KeyError(5), ConnectionRefusedError(111, "refused"), FileNotFoundError(2, "x")],
)
def test_a_batch_is_halved_until_the_one_that_raises_is_alone(error):
    requests = []

    def roll_out(tasks):
        requests.append(list(tasks))
        if 5 in tasks:
            raise error
        return whole(tasks)

    finished, ended = attempt(roll_out, list(range(8)))
    assert [task for tasks, _ in finished for task in tasks] == [0, 1, 2, 3, 4, 6, 7]
    assert [(task, why["reason"]) for task, why in ended] == [
        (5, f"raised {type(error).__name__}")
    ]
    assert len(requests) == 7


@pytest.mark.parametrize(
    ("wrong", "detail"), [(None, "here"), (99, "lost"), (-1, "lost")]
)
def test_rows_that_a_planner_names_are_believed_where_the_batch_has_them(wrong, detail):
    def roll_out(tasks):
        if 5 in tasks:
            raise PlannerError(
                "lost", {tasks.index(5): "here"} if wrong is None else {wrong: "there"}
            )
        return whole(tasks)

    finished, ended = attempt(roll_out, [4, 5, 6])
    assert [task for tasks, _ in finished for task in tasks] == [4, 6]
    assert [(task, why["detail"]) for task, why in ended] == [(5, detail)]


def test_a_traceback_is_of_the_rollout_alone():
    """The errors of the batches that it was halved from are no part of it."""

    def roll_out(tasks):
        if 5 in tasks:
            raise KeyError(len(tasks))
        return whole(tasks)

    _, ((_, why),) = attempt(roll_out, list(range(8)))
    assert why["traceback"].count("Traceback (most recent call last)") == 1
    assert why["traceback"].endswith("KeyError: 1\n")
