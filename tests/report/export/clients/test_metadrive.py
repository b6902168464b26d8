"""MetaDrive replays ScenarioNet exports: contacts at the same steps; its summaries are
the exported ones."""

import csv

import pytest

from e2rl.evaluation.rollout_files import TABLE
from tests.report.export.clients.environment import answer, environment
from tests.report.export.small_run import exported

pytestmark = [pytest.mark.slow, pytest.mark.clients]
HISTORY = 10  # frames before the start


@pytest.fixture(scope="module")
def metadrive():
    return environment("metadrive")


def test_contacts_are_at_the_same_step_and_summaries_the_same(run, metadrive, tmp_path):
    exported(run, tmp_path / "out", "scenarionet")
    read = answer(metadrive, "metadrive_replay", tmp_path / "out")
    with (run / TABLE).open(newline="") as file:
        steps = [
            int(float(row["contact_step"])) if row["contact_step"] else None
            for row in csv.DictReader(file)
        ]
    assert len(read) == len(steps)
    for result, step in zip(read, steps, strict=True):
        assert (result["contact"] is None) == (step is None)
        if step is not None:
            assert result["contact"] == pytest.approx(
                step + HISTORY, abs=1
            )  # boxes have a margin there
        assert result["differing"] == [
            "map_height_diff"
        ]  # which is -inf there, of maps without lines
