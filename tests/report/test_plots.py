"""Learning curves: which environment steps a value belongs to, and runs that have none."""

import pytest

from e2rl.learning.logging import RunLogger
from e2rl.report.plots import learning_curves, read_curves
from e2rl.run.errors import InputError


def logged(folder, rounds):
    logger = RunLogger("csv", folder)
    for number, (frames, attacked, hit) in enumerate(rounds):
        metrics = {"train/frames": frames, "synthesizer/contact": attacked, "train/contact_adversarial": hit}
        logger.log(metrics, number)
    logger.close()
    return folder


def test_what_was_measured_before_a_round_stands_at_the_steps_done_by_then(tmp_path):
    found = read_curves(logged(tmp_path / "run", [(100, 0.7, 0.5), (250, 0.6, 0.4)]))
    assert found["synthesizer/contact"] == ([0, 100], [0.7, 0.6])
    assert found["train/contact_adversarial"] == ([100, 250], [0.5, 0.4]) and len(found) == 2


def test_a_folder_without_a_log_is_named(tmp_path):
    with pytest.raises(InputError, match="nothing: no train/frames logged there; give the folder"):
        learning_curves([tmp_path / "nothing"])
