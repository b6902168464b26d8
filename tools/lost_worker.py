"""python -m tools.lost_worker [OPTION ...]: an evaluation by two Ray workers, one of which is killed (extra `ray`).

The methods of evaluate.py, with its options, run by two forked processes, by two Ray workers, and by two Ray workers of
which one is killed when it has written the rollouts of a batch, but not yet that the batch is finished. Prints the wall
times, without Ray's start, and what differs from the first run; the exit status is 1 where something does.
"""

import os
import signal
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from e2rl.evaluation import methods as build_objects
from e2rl.evaluation.protocol import Setup, run_protocol
from e2rl.evaluation.rollout_files import ROLLOUTS
from e2rl.run import config as build_config
from e2rl.run.parts import PARTS, Kept
from e2rl.run.processes import RayWorkers
from e2rl.scenes.source import load_scenes
from tools.kills import differences

WORKERS = 2


class Mortal(Setup):
    """A setup that kills the process in which it is used after the rollouts of an attacked batch, once."""

    mark: Path  # is written then

    def score(self, method, tasks, folder=None):
        found = super().score(method, tasks, folder)
        if method.eta and not self.mark.exists():
            self.mark.write_text(str(os.getpid()))
            os.kill(os.getpid(), signal.SIGKILL)
        return found


def main(overrides: list[str]) -> int:
    config = build_config.load_config("evaluate", overrides)
    build_config.set_up(config)
    build_objects.check_evaluation(config)
    prior, _ = build_objects.build_prior(config)
    methods, ego = build_objects.build_methods(config, prior), build_objects.build_ego(config)
    scenes, ray = load_scenes(config.data, config.num_scenes), RayWorkers(WORKERS)
    given = (scenes, ego, "ego", build_objects.build_sim(config), config.batch)
    begin = time.perf_counter()
    ray.connect()
    print(f"Ray started in {time.perf_counter() - begin:.0f} s")
    runs = {"processes": (Setup(*given), WORKERS), "Ray workers": (Setup(*given), ray)}
    runs["Ray workers, one killed"] = mortal, _ = Mortal(*given), ray
    with TemporaryDirectory() as temporary:
        mortal.mark, first, wrong = Path(temporary) / "killed", None, []
        for name, (setup, processes) in runs.items():
            folder, begin = Path(temporary) / name.replace(" ", "-"), time.perf_counter()
            run_protocol(setup, methods, config.seeds, folder, processes=processes, kept=Kept(folder))
            spent, first = time.perf_counter() - begin, first or folder
            rollouts, batches = len(list((folder / ROLLOUTS).iterdir())), len(list((folder / PARTS).iterdir()))
            wrong += (differs := differences(first, folder))
            done = f"{rollouts} rollouts in {batches} batches, {spent:.0f} s"
            print(f"{WORKERS} {name}: {done}; differs: {differs or 'nothing'}", flush=True)
        print(f"killed: process {mortal.mark.read_text()}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
