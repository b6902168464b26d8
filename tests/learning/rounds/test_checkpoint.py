"""r rounds and r more after a resume are 2r rounds, bit for bit; nothing half-written,
nothing misread."""

import pytest
import torch

from e2rl.learning.rounds.checkpoint import load_checkpoint, save_checkpoint
from e2rl.planners.actor import ActorEgo
from e2rl.run.errors import InputError
from e2rl.run.files import SEAL, seal
from tests.learning.small import rounds, small_run

KINDS = {
    "replay": {},
    "prefetch": {"prefetch": True},
    "evading": {"evades": True},
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_resumed_rounds_are_those_of_one_run(tmp_path, kind):
    settings = {
        "spread": 0.5,
        "memory": 8,
        "collect": {"hold": 2},
        "final_lr": 1.0,
        **KINDS[kind],
    }
    whole = small_run(seed=3, folder=tmp_path / "whole", **settings)
    expected = rounds(whole, 4)
    folder, shorter = tmp_path / "run", 2  # a run of two rounds, to which two are added
    first = small_run(
        seed=3,
        folder=folder,
        rounds=shorter,
        **settings,
    )
    start = rounds(first, 2)
    save_checkpoint(folder, first)
    second = small_run(seed=99, folder=folder, **settings)
    second.seed = 3
    assert load_checkpoint(folder, second) == 2
    assert start + rounds(second, 2) == expected
    for key, value in whole.ego.network.weights().items():
        assert torch.equal(value, second.ego.network.weights()[key]), key
    assert whole.memory.index() == second.memory.index()
    assert len(whole.memory.rounds) == 2
    for single, other in zip(whole.memory.rounds, second.memory.rounds, strict=True):
        assert all(
            torch.equal(value, other.traffic[key])
            for key, value in single.traffic.items()
        )


def test_the_memory_keeps_what_the_newest_checkpoints_name(tmp_path):
    run = small_run(folder=tmp_path, memory=6)
    for _ in range(4):
        rounds(run, 1)
        save_checkpoint(tmp_path, run, keep_last=2)
    assert [path.name for path in sorted((tmp_path / "checkpoints").iterdir())] == [
        "round-000003",
        "round-000004",
    ]
    assert sorted((tmp_path / "memory").iterdir()) == [
        run.memory.path(k) for k in (1, 2, 3)
    ], "two rounds of each"


def test_what_is_missing_or_damaged_in_the_memory_is_named(tmp_path):
    run = small_run(folder=tmp_path)
    rounds(run, 2)
    save_checkpoint(tmp_path, run)
    file = run.memory.path(0)
    whole = file.read_bytes()
    flipped = whole[:-1] + bytes([whole[-1] ^ 1])
    other = run.memory.path(1).read_bytes()
    for content in (whole[:200], flipped, other):
        file.write_bytes(content)
        with pytest.raises(InputError, match=f"{file}.*damaged"):
            load_checkpoint(tmp_path, small_run(folder=tmp_path))
    file.unlink()
    with pytest.raises(InputError, match=f"{file}.*missing"):
        load_checkpoint(tmp_path, small_run(folder=tmp_path))


def test_what_does_not_fit_is_refused_and_named(tmp_path):
    run = small_run(folder=tmp_path)
    rounds(run, 1)
    folder = save_checkpoint(tmp_path, run)
    with pytest.raises(
        InputError,
        match=r"actor\.safetensors: an actor of another architecture",
    ):
        load_checkpoint(tmp_path, small_run(hidden=(8,), folder=tmp_path))
    for content, what in (
        (b"half of it", r"state\.pt: damaged"),
        ({"format": "e2rl-checkpoint/3"}, "of format e2rl-checkpoint/3"),
    ):
        torch.save(content, folder / "state.pt")
        seal(folder)
        with pytest.raises(InputError, match=what):
            load_checkpoint(tmp_path, small_run())


@pytest.mark.parametrize(
    ("file", "how"),
    [
        ("state.pt", "flipped"),
        ("actor.safetensors", "torn"),
        ("state.pt", "missing"),
        (SEAL, "torn"),
    ],
)
def test_a_damaged_checkpoint_is_passed_over_for_the_one_before_it(
    tmp_path, capsys, file, how
):
    run = small_run(folder=tmp_path)
    for _ in range(2):
        rounds(run, 1)
        save_checkpoint(tmp_path, run)
    older, newer = sorted((tmp_path / "checkpoints").iterdir())
    content = (newer / file).read_bytes()
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    if how == "missing":
        (newer / file).unlink()
    else:
        (newer / file).write_bytes(flipped if how == "flipped" else content[:middle])
    other = small_run(seed=5, folder=tmp_path)
    assert load_checkpoint(tmp_path, other) == 1
    assert "passed over: " in capsys.readouterr().err
    saved = ActorEgo(hidden=(16,), checkpoint=str(older)).network.weights()
    result = ActorEgo(hidden=(16,), checkpoint=str(tmp_path)).network.weights()
    assert all(torch.equal(value, saved[key]) for key, value in result.items())
    assert all(
        torch.equal(value, saved[key])
        for key, value in other.ego.network.weights().items()
    )
    for left in older.iterdir():
        left.write_bytes(b"")
    for load in (
        lambda: load_checkpoint(tmp_path, other),
        lambda: ActorEgo(hidden=(16,), checkpoint=str(tmp_path)),
    ):
        with pytest.raises(InputError, match="damaged"):
            load()
