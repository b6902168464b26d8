"""SUMO: trajectories that are the rollout's one step later, told by the reader of SUMO's
outputs."""

from xml.etree import ElementTree

import numpy as np
import pytest

pytest.importorskip("sumolib", reason="--to sumo needs the extra sumo")
pytest.importorskip("scenariogeneration", reason="--to sumo needs the extra sumo")
from e2rl.evaluation.rollout_files import TABLE, read_rows  # noqa: E402
from e2rl.report.export.scene_files import episodes_of  # noqa: E402
from e2rl.report.export.sumo_writer import (  # noqa: E402
    trajectories,
    vehicle_types,
)
from e2rl.scenes.paths import wrap  # noqa: E402
from e2rl.scenes.recording import AGENT_TYPES  # noqa: E402
from e2rl.scenes.sumo import Net, read_run  # noqa: E402
from e2rl.scenes.sumo import vehicle_types as read_types

NO_NET = b'<net version="1.20"/>'


def test_the_reader_of_sumo_s_outputs_gets_the_rollout_back(run):
    row = read_rows(run / TABLE)[1]  # nobody jumps
    (episode,) = episodes_of(run, [row], plugins=[], scene=False)
    kinds = read_types(ElementTree.tostring(vehicle_types(episode)))
    recording, names = read_run(
        ElementTree.tostring(trajectories(episode, "-1_0")),
        Net(NO_NET),
        kinds=kinds,
        lights={},
    )
    rollout = episode.rollout
    assert len(recording.states) == episode.steps + 2
    for row in episode.agents:
        name = f"vehicle {episode.name(row)}"
        for number, (first, end) in enumerate(episode.appearances(row), 1):
            track = names.index(name if number == 1 else f"{name}#{number}")
            valid = np.zeros(episode.steps + 2, bool)
            valid[first : end + 1] = True
            assert recording.valid[:, track].tolist() == valid.tolist()
            error = recording.states[first + 1 : end + 1, track]
            error = error - rollout.states[first:end, row]
            assert np.abs(error[:, :2]).max() < 1e-3
            assert np.abs(wrap(error[:, 2])).max() < 1e-4
            assert recording.size[track] == pytest.approx(rollout.size[row], abs=1e-3)
            kind = AGENT_TYPES[recording.agent_type[track]]
            expected = str(rollout.agent_type[row])
            assert kind == ("vehicle" if expected == "other" else expected)
