"""A run that cannot fit is refused with its estimate, one that may not fit is told, and the machine is read rightly."""

import pytest

from e2rl.evaluation import capacity
from e2rl.evaluation.capacity import (
    ATTACKED,
    ROLLOUT,
    Need,
    Room,
    check_fits,
    evaluation_need,
    room_here,
    scene_bytes,
    training_need,
)
from e2rl.evaluation.protocol import Method
from e2rl.run.config import load_config
from e2rl.run.errors import InputError
from e2rl.traffic.rule_based import Replay
from tests.scripts import SHORT, call, error_line
from tests.traffic.e2.traffic_scenes import scenes

GB = 1e9
NEED = Need(10 * GB, "4 scenes, 2 x 32 rollouts", "a smaller batch")


def test_what_can_never_fit_is_refused_and_what_does_not_fit_now_is_told(capsys):
    with pytest.raises(InputError, match=r"needs about 10.0 GB .4 scenes.*machine has 8.0 GB; set a smaller batch"):
        check_fits(NEED, Room(8 * GB, 8 * GB))
    check_fits(NEED, Room(16 * GB, 4 * GB))
    assert "10.0 GB (4 scenes, 2 x 32 rollouts), 4.0 GB are free; if it is killed" in capsys.readouterr().err
    check_fits(NEED, Room(16 * GB, 12 * GB))
    assert capsys.readouterr().err == ""


def machine(root, total, free, limit=None, used=0, one="memory.max", two="memory.current"):
    (root / "proc").mkdir(parents=True)
    lines = [
        f"MemTotal: {int(total / 1024)} kB",
        "MemFree: 1 kB",
        f"MemAvailable: {int(free / 1024)} kB",
        "Hugepages: 0",
    ]
    (root / "proc" / "meminfo").write_text("\n".join(lines))
    if limit is not None:
        for name, value in ((one, limit), (two, used)):
            path = root / "sys" / "fs" / "cgroup" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{value}\n")
    return room_here(root)


def test_a_container_has_what_it_may_have(tmp_path):
    assert machine(tmp_path / "a", 64 * GB, 20 * GB) == pytest.approx((64 * GB, 20 * GB), abs=2000)
    assert machine(tmp_path / "b", 64 * GB, 20 * GB, "max", "0") == pytest.approx((64 * GB, 20 * GB), abs=2000)
    small = machine(tmp_path / "c", 64 * GB, 20 * GB, int(8 * GB), int(3 * GB))
    assert small == pytest.approx((8 * GB, 5 * GB), abs=2000)
    old = ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes")
    assert machine(tmp_path / "d", 64 * GB, 2 * GB, int(8 * GB), 0, *old) == pytest.approx((8 * GB, 2 * GB), abs=2000)
    assert room_here(tmp_path / "nothing") is None


def test_rollouts_at_once_and_processes_are_what_an_evaluation_needs():
    few, nominal = scenes(4, steps=20), Method("replay", Replay())
    attack = Method("e2", Replay(), 2.0)

    def total(methods, batch=4, processes=1, seeds=1, egos=1):
        return evaluation_need(few, methods, seeds, egos, batch, processes).total

    assert total([attack]) - total([nominal]) == pytest.approx(4 * (ATTACKED - ROLLOUT) * 0.1)
    assert total([nominal], processes=3) > total([nominal], processes=2) > total([nominal])
    assert total([nominal], batch=400) == total([nominal]), "no more rollouts at once than there are"
    assert total([nominal], seeds=500) > total([nominal], seeds=1) + 4 * 499 * 0.02e6
    assert scene_bytes(few) == sum(value.nbytes for value in few.scenes.values())


def test_a_training_needs_its_environments_beside_the_next_round_s_synthesis():
    few = scenes(4, steps=20)

    def total(*overrides):
        return training_need(load_config("train", overrides), few, few, 2).total

    assert total("learner.collect.batch=4096") > 2 * total("learner.collect.batch=256") - 1 * GB
    assert total("learner.collect.batch=100000") > 50 * GB and total() < 4 * GB
    assert total("learner=planner_tuning", "ego=lane_graph") < total()


@pytest.mark.parametrize("script", ["evaluate.py", "train.py"])
def test_the_commands_ask_before_the_first_rollout(script, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(capacity, "room_here", lambda: Room(0.1 * GB, 0.1 * GB))
    status, said = call(script, [*SHORT, f"hydra.run.dir={tmp_path}", f"data.cache={tmp_path}"], monkeypatch, capsys)
    assert status == 2 and "memory: the run needs about" in error_line(said) and "0.1 GB; set" in error_line(said)
    assert not list(tmp_path.rglob("*.npz"))
