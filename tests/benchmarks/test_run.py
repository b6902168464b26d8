"""Every benchmark runs, and writes rows that can be read, at a size that takes seconds."""

import json
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
sys.path.insert(
    0, str(FOLDER)
)  # the benchmarks are scripts beside each other, as their command sees them

import run  # noqa: E402

from e2rl.run.errors import InputError  # noqa: E402

SMALL = [
    "--repeats",
    "1",
    "--largest",
    "1",
    "--no-compile",
    "--set",
    "data.build.steps=20",
    "data.build.field_cells=128",
    "prior.sampler.steps=2",
]
SHORT = [
    "--train",
    "num_scenes=2",
    "batch=2",
    "learner.round.scenes=1",
    "learner.collect.batch=2",
    "learner.collect.steps=20",
    "learner.collect.iterations=1",
    "learner.ppo.epochs=1",
    "measure.scenes=1",
    "measure.budget=0",
]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The rows of all benchmarks, which load the scenes once."""
    path = tmp_path_factory.mktemp("benchmarks") / "rows.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("searched_rollouts.TRIES", 1)
        run.main(["--json", str(path), *SMALL, *SHORT])
    return json.loads(path.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(run.BENCHMARKS))
def test_every_benchmark_runs(name, written):
    rows = [row for row in written if row["benchmark"] == name]
    assert rows
    if name.startswith("peer_"):  # they are not installed where the tests run
        assert all(
            row["value"] or row["variant"].startswith("absent: ") for row in rows
        )
        return
    assert min(row["value"] for row in rows) > 0
    assert {row["threads"] for row in rows} == {1}
    assert all(row["versions"]["torch"] for row in rows)
    assert len(
        {(row["variant"], row["batch"], row["unit"], row["processes"]) for row in rows}
    ) == len(rows)


def test_impossible_sizes_are_refused(tmp_path):
    with pytest.raises(InputError, match="--largest 0"):
        run.main(["--json", str(tmp_path / "rows.json"), "--largest", "0"])
