"""`python tools/showcase.py`: the pictures of the README, from bundled scenes and
weights.

Moving, of one scene and seed: nominal traffic around the untrained actor; the same
actor attacked by e2; the trained actor, which e2 attacks anew.
"""

import argparse
from pathlib import Path

from e2rl.driving.setup import Method, Setup, Task
from e2rl.evaluation.build import build_ego, build_prior, build_sim, build_traffic
from e2rl.metrics.score import score_rollouts
from e2rl.report.picture import Replay
from e2rl.report.videos import save_animation
from e2rl.run.config import load_choice, load_config
from e2rl.run.endings import ending
from e2rl.scenes.source import load_scenes

SCENE, SEED, ETA = "arterial_065_0440", 0, 2.0  # of the bundled test scenes
METRES = 60.0
PIXELS = 400
COLOURS = 32
PICTURES = {  # file: the ego's checkpoint, traffic, two lines of the picture
    "nominal": (None, "nominal", ("Nominal traffic", "untrained policy")),
    "attacked": (None, "e2", ("Attacked by e2", "untrained policy")),
    "trained": ("bundled", "e2", ("After training", "e2 attacks it anew")),
}


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python tools/showcase.py", description=__doc__
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("docs/assets"),
        help="folder (default %(default)s)",
    )
    parser.add_argument(
        "--scene",
        default=SCENE,
        metavar="ID",
        help="a bundled test scene (default %(default)s)",
    )
    options = parser.parse_args(arguments)
    with ending():
        config = load_config("evaluate", ["ego=actor", "data.workers=1"])
        scenes = load_scenes(config.data)
        prior = build_prior(config)[0]
        sim = build_sim(config)
        for name, (checkpoint, traffic, caption) in PICTURES.items():
            config.ego.checkpoint = checkpoint
            setup = Setup(scenes, build_ego(config), "actor", sim)
            method = Method(
                traffic,
                build_traffic(load_choice("synthesizer", traffic), prior),
                ETA if traffic == "e2" else 0.0,
            )
            rollouts = setup.roll_out(method, [Task(scenes.index(options.scene), SEED)])
            row = score_rollouts(rollouts)[0][0]
            frames = Replay(
                rollouts.rollout(0), row, METRES, PIXELS, caption=caption
            ).frames()
            save_animation(options.out / f"{name}.gif", frames, COLOURS)
            outcome = "hit" if row["cfr"] else "no collision"
            print(
                f"{options.out / name}.gif: {outcome}, {row['progress']:.0f} m driven"
            )


if __name__ == "__main__":
    main()
