"""Scalars land in a file each, in the known groups, and go on after a resume."""

import pytest

from e2rl.learning.logging import RunLogger
from e2rl.run.errors import InputError


def test_unknown_groups_and_kinds_are_refused(tmp_path):
    with pytest.raises(InputError, match="loss"):
        RunLogger("none", tmp_path).log({"loss": 1.0}, 0)
    with pytest.raises(InputError, match="logger.kind=paper"):
        RunLogger("paper", tmp_path)


def test_what_a_resumed_run_logs_again_is_not_doubled(tmp_path):
    """Also where the run was killed in the midst of a line."""
    RunLogger("csv", tmp_path).log({"train/loss": 0.5, "time/improve": 2.0}, 0)
    RunLogger("csv", tmp_path).log({"train/loss": 0.25, "time/improve": 3.0}, 1)
    with (tmp_path / "logs" / "scalars" / "train" / "loss.csv").open("a") as file:
        file.write("2,0.1")
    logger = RunLogger("csv", tmp_path)
    logger.forget(1)
    logger.log({"train/loss": 0.25, "time/improve": 3.0}, 1)
    scalars = tmp_path / "logs" / "scalars"
    assert (scalars / "train" / "loss.csv").read_text().split() == ["0,0.5", "1,0.25"]
    assert (scalars / "time" / "improve.csv").read_text().split() == ["0,2.0", "1,3.0"]
