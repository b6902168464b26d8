"""`python -m e2rl.commands.showcase`: the pictures of the README, from bundled scenes and weights.

Moving, of one scene and seed: nominal traffic around the untrained actor; the same actor attacked by e2; the trained
actor, which e2 attacks anew. With `--run RUN_DIR` also the failure report of a run as it opens in Chromium (extra
`browser`).
"""

import argparse
import io
import shutil
from importlib.util import find_spec
from pathlib import Path

from PIL import Image

from e2rl.evaluation.methods import build_ego, build_prior, build_sim, build_traffic
from e2rl.evaluation.protocol import Method, Setup
from e2rl.metrics.score import score_rollouts
from e2rl.report.html import write_report
from e2rl.report.picture import Replay
from e2rl.report.videos import save_animation
from e2rl.run.config import load_choice, load_config
from e2rl.run.endings import ending
from e2rl.run.errors import InputError
from e2rl.scenes.source import load_scenes

SCENE, SEED, ETA = "arterial_065_0440", 0, 2.0  # of the bundled test scenes
METRES, PIXELS, COLOURS = 60.0, 400, 32
WINDOW = "1360,1130"  # pixels, with 139 that the window's frame takes
PICTURES = {  # file: the ego's checkpoint, traffic, two lines of the picture
    "nominal": (None, "nominal", ("Nominal traffic", "untrained policy")),
    "attacked": (None, "e2", ("Attacked by e2", "untrained policy")),
    "trained": ("bundled", "e2", ("After training", "e2 attacks it anew")),
}


def photograph(page: Path, picture: Path) -> None:
    """Write what Chromium shows of a failure report, a second before the contact of the first failure."""
    browser, driver = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    if not (find_spec("selenium") and browser and driver):
        raise InputError("--run: needs the extra browser, and chromium and chromedriver on the path; leave it out")
    from selenium import webdriver
    from selenium.webdriver.support.ui import WebDriverWait

    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for flag in ("--headless", "--no-sandbox", f"--window-size={WINDOW}", "--hide-scrollbars"):
        options.add_argument(flag)
    with webdriver.Chrome(options, webdriver.ChromeService(driver)) as window:
        window.get(page.resolve().as_uri())
        WebDriverWait(window, 20).until(lambda opened: opened.execute_script("return page.player.replay !== null"))
        window.execute_script("page.player.seek(Math.max(0, page.player.replay.contact - 10))")
        shown = Image.open(io.BytesIO(window.get_screenshot_as_png())).convert("RGB")
    shown.quantize(256).save(picture, optimize=True)


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m e2rl.commands.showcase", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/assets"), help="folder (default %(default)s)")
    parser.add_argument("--scene", default=SCENE, metavar="ID", help="a bundled test scene (default %(default)s)")
    parser.add_argument("--run", type=Path, metavar="RUN_DIR", help="of evaluate.py, whose report is shown")
    options = parser.parse_args(arguments)
    with ending():
        if options.run:
            photograph(write_report(options.run), options.out / "report.png")
        config = load_config("evaluate", ["ego=actor", "data.workers=1"])
        scenes, prior, sim = load_scenes(config.data), build_prior(config)[0], build_sim(config)
        for name, (checkpoint, traffic, caption) in PICTURES.items():
            config.ego.checkpoint = checkpoint
            setup = Setup(scenes, build_ego(config), "actor", sim)
            method = Method(
                traffic, build_traffic(load_choice("synthesizer", traffic), prior), ETA if traffic == "e2" else 0.0
            )
            rollouts = setup.roll_out(method, [(scenes.index(options.scene), SEED)])
            row = score_rollouts(rollouts)[0][0]
            frames = Replay(rollouts.rollout(0), row, METRES, PIXELS, caption=caption).frames()
            save_animation(options.out / f"{name}.gif", frames, COLOURS)
            outcome = "hit" if row["cfr"] else "no collision"
            print(f"{options.out / name}.gif: {outcome}, {row['progress']:.0f} m driven")


if __name__ == "__main__":
    main()
