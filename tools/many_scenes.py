"""python -m tools.many_scenes LOGS [--scenes N] [--evaluate N] [--evaluate N] [OPTION ...]: 10,000 scenes of few logs.

Each log of LOGS, a ScenarioNet folder or zip, is cut at 17 starts 0.2 s apart, as recorded and mirrored. Prints time
and peak memory of building N scenes into an empty cache and the cache's size; then, for each `--evaluate`, time, peak
memory and failures of driving the methods of evaluate.py (OPTION: its options) in N of them, spread over all. Both are
done in processes of their own, of which the peak memory is told, and, apart, that of the largest of their workers.
"""

import argparse
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from e2rl.evaluation import methods as build_objects
from e2rl.evaluation.protocol import Setup, drive_all
from e2rl.run import config as build_config
from e2rl.run.processes import die_with_parent
from e2rl.scenes.scene import SceneSet
from e2rl.scenes.source import load_scenes

STARTS = list(range(10, 44, 2))  # frames of a log of 9.1 s: each leaves half of the steps recorded


def scenes_of(config, most: int) -> SceneSet:
    return load_scenes({**config.data, "mirror": True}, most, starts=STARTS)


def build_many(overrides: list[str], most: int) -> str:
    config = build_config.load_config("evaluate", overrides)
    begin, before = time.perf_counter(), cpu()
    count = len(scenes_of(config, most))
    spent, used = time.perf_counter() - begin, cpu() - before
    size = sum(file.stat().st_size for file in Path(config.data.cache).iterdir())
    each = f"{used / count:.3f} s of CPU and {size / count / 1e6:.3f} MB each"
    return f"built {count} scenes in {spent:.0f} s: {each}, cache {size / 1e6:.0f} MB, {peak()}"


def drive_many(overrides: list[str], most: int, driven: int) -> str:
    config, before = build_config.load_config("evaluate", overrides), cpu()
    build_config.set_up(config)
    build_objects.check_evaluation(config)
    methods = build_objects.build_methods(config, build_objects.build_prior(config)[0])
    ego, sim = build_objects.build_ego(config), build_objects.build_sim(config)
    begin = time.perf_counter()
    scenes = scenes_of(config, most)
    opened, only = time.perf_counter() - begin, torch.linspace(0, len(scenes) - 1, driven).long().tolist()
    begin = time.perf_counter()
    setup = Setup(scenes, ego, "ego", sim, config.batch)
    rows, _, lost = drive_all([setup], methods, config.seeds, None, build_objects.processes_of(config), only)
    spent, failures = time.perf_counter() - begin, sum(row["cfr"] for row in rows)
    rate = f"{failures:.0f} failures, {3600 * failures / spent:.0f} an hour; {len(lost)} without a score"
    begun = f"opened {len(scenes)} scenes in {opened:.1f} s, drove {len(rows)} rollouts in {driven} of them"
    return f"{begun} in {spent:.0f} s: {rate}; {(cpu() - before) / max(len(rows), 1):.2f} s of CPU a rollout, {peak()}"


def cpu() -> float:
    """Seconds of this process and of its workers that have ended."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in both)


def peak() -> str:
    own, worker = (resource.getrusage(who).ru_maxrss / 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return f"at most {own:.0f} MiB resident, {worker:.0f} in a worker"


def told(function: Callable[..., str], *arguments) -> None:
    if (parent := multiprocessing.parent_process()) is not None and parent.pid is not None:
        die_with_parent(parent.pid)
    print(function(*arguments), flush=True)


def apart(function: Callable[..., str], *arguments) -> None:
    """Print what a function returns in a process of its own, which may have workers."""
    process = multiprocessing.get_context("spawn").Process(target=told, args=(function, *arguments))
    process.start()
    process.join()
    if process.exitcode:
        sys.exit(process.exitcode)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.many_scenes", description=__doc__.splitlines()[0])
    parser.add_argument("logs", metavar="LOGS", help="folder or zip of ScenarioNet logs")
    parser.add_argument("--scenes", type=int, default=10_000, metavar="N", help="to build (default %(default)s)")
    parser.add_argument("--evaluate", type=int, action="append", default=[], metavar="N", help="scenes to drive in")
    options, overrides = parser.parse_known_args(arguments)
    with TemporaryDirectory() as cache:
        overrides = ["data=scenarionet", f"data.path={options.logs}", f"data.cache={cache}", *overrides]
        apart(build_many, overrides, options.scenes)
        for driven in options.evaluate:
            apart(drive_many, overrides, options.scenes, driven)


if __name__ == "__main__":
    main()
