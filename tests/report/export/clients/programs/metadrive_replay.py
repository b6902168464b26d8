"""MetaDrive replays a folder of scenarios without rendering: what its reader says of
each, and the first contact.

MetaDrive loads its textures from outside of the package; without rendering it asks only
whether they are there.
"""

import json
import sys
from pathlib import Path

import metadrive

assets = Path(metadrive.__file__).parent / "assets"
texture = assets / "textures" / "grass1" / "GroundGrassGreen002_COL_1K.jpg"
texture.parent.mkdir(parents=True, exist_ok=True)
texture.touch()
(assets / "version.txt").write_text("0.4.3")

from metadrive.envs.scenario_env import ScenarioEnv  # noqa: E402
from metadrive.policy.replay_policy import ReplayEgoCarPolicy  # noqa: E402
from metadrive.scenario import ScenarioDescription  # noqa: E402
from metadrive.scenario.utils import read_dataset_summary, read_scenario_data  # noqa: E402


def plain(summary: dict) -> dict:
    """Sets as sorted lists, dictionaries with defaults as plain ones."""
    return {
        key: sorted(value)
        if isinstance(value, (set, list))
        else dict(value)
        if isinstance(value, dict)
        else value
        for key, value in summary.items()
    }


folder = sys.argv[1]
_, names, _ = read_dataset_summary(folder)
settings = {
    "data_directory": folder,
    "num_scenarios": len(names),
    "agent_policy": ReplayEgoCarPolicy,
    "use_bounding_box": True,
    "crash_vehicle_done": False,
    "log_level": 50,
}
env = ScenarioEnv(settings)
for index, name in enumerate(names):
    made = read_scenario_data(str(Path(folder) / name))
    ScenarioDescription.sanity_check(dict(made), check_self_type=True, valid_check=True)
    ours = plain(made["metadata"]["number_summary"])
    ScenarioDescription.update_summaries(made)
    theirs = plain(made["metadata"]["number_summary"])
    differing = [key for key in theirs if ours.get(key) != theirs[key]]
    env.reset(seed=index)
    contacts = []
    step = 0
    over = False
    while not over:
        _, _, terminated, truncated, info = env.step([0, 0])
        step += 1
        if info["crash_vehicle"]:
            contacts.append(step)
        over = terminated or truncated
    print(
        "answer:",
        json.dumps(
            {
                "contact": next(iter(contacts), None),
                "steps": step,
                "differing": differing,
            }
        ),
    )
env.close()
