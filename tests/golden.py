"""Golden rollouts: what each method and each ego does, one round of training and one
search, as digests.

`python -m tests.golden [CASE...]` writes golden.json anew: after a change that is meant
to move results, or on another processor.
"""

import csv
import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import torch
from safetensors.torch import load_file

import e2rl
from e2rl.run.fused import machine
from e2rl.sim.rollouts import Rollouts
from tests.scripts import ROOT

FILE = Path(__file__).with_name("golden.json")
SCENES = 8
ETA = 2.0
METHODS = (
    "replay",
    "constant_velocity",
    "idm",
    "nominal",
    "e2",
    "e2_pursuit",
    "e2_unbound",
    "ccdiff",
    "ctg",
    "ctg_adv",
    "diffscene",
    "safe_sim_opt",
    "cat",
    "strive",
)
EGOS = ("replay", "idm", "lane_graph_tuned", "sampling", "pdm_closed", "bits", "actor")
NOT_HELD = ("seconds",)  # columns that differ from run to run
SCRIPT = ["data=bundled", "compile=false", "hydra.job_logging.root.handlers=[]"]
SEARCH = [
    *SCRIPT,
    f"num_scenes={SCENES}",
    "methods=[search]",
    "seeds=[0]",
    "processes=1",
    "report=false",
    "save_rollouts=false",
]
TRAINING = [
    *SCRIPT,
    "seed=0",
    "rounds=1",
    "num_scenes=4",
    "learner.round.scenes=4",
    "learner.collect.batch=16",
    "learner.collect.iterations=2",
    "learner.round.prefetch=false",
    "measure.scenes=2",
    "measure.seeds=[0]",
    "measure.budget=0",
]
Record = dict[str, object]


def processor() -> str:
    """Returns what bits of floating-point results depend on, as a digest."""
    return digest(repr((torch.__version__, machine()[2])).encode())


def digest(*parts: bytes) -> str:
    """Returns 16 hexadecimal digits of the parts' SHA-256."""
    total = hashlib.sha256()
    for part in parts:
        total.update(part)
    return total.hexdigest()[:16]


@cache
def scenes_and_prior() -> tuple:
    """Returns the bundled scenes that are driven, and the bundled prior."""
    return e2rl.load_scenes("bundled", num_scenes=SCENES), e2rl.load_prior()


@cache
def rollouts_of(method: str, ego: str) -> Rollouts:
    """Returns the rollouts of a method against an ego in all scenes."""
    scenes, prior = scenes_and_prior()
    traffic = e2rl.make_traffic(method, prior)
    return e2rl.roll_out(scenes, e2rl.make_ego(ego), traffic=traffic, eta=ETA)


def record_of(method: str, ego: str) -> Record:
    """Returns the record of a method against an ego in all scenes."""
    return rollouts_record(rollouts_of(method, ego))


def rollouts_record(rollouts: Rollouts) -> Record:
    """Returns digests of states and of scored rows, and numbers [B] that tell how far
    apart two machines are."""
    states = rollouts.states * rollouts.valid[..., None]
    rows = [held(row) for row in e2rl.score(rollouts)]
    return {
        "states": digest(states.numpy().tobytes(), rollouts.valid.numpy().tobytes()),
        "rows": digest(json.dumps(rows, default=str).encode()),
        "places": [
            round(value, 2) for value in states[:, -1, :, :2].sum((1, 2)).tolist()
        ],
        "hits": [int(row["cfr"] == 1) for row in rows],
        "nats": [round(float(row["transport"]), 1) for row in rows],
    }


def held(row: dict) -> dict:
    """Returns the columns of a row that are the same in every run."""
    return {name: value for name, value in row.items() if name not in NOT_HELD}


def searched() -> Record:
    """Returns the record of one search: every try's row."""
    with tempfile.TemporaryDirectory() as folder:
        command("evaluate.py", *SEARCH, f"hydra.run.dir={folder}/run")
        with open(f"{folder}/run/rollouts.csv", newline="") as file:
            rows = [held(row) for row in csv.DictReader(file)]
    return {
        "rows": digest(json.dumps(rows).encode()),
        "hits": [int(float(row["cfr"] or 0) == 1) for row in rows],
    }


def trained() -> Record:
    """Returns the record of one round of training: the actor's weights after it."""
    with tempfile.TemporaryDirectory() as folder:
        command("train.py", *TRAINING, f"hydra.run.dir={folder}/run")
        weights = load_file(
            Path(folder, "run", "checkpoints", "round-000001", "actor.safetensors")
        )
    content = [weights[name].numpy().tobytes() for name in sorted(weights)]
    total = sum(weights[name].double().abs().sum() for name in sorted(weights))
    return {"weights": digest(*content), "size": round(float(total), 2)}


def command(script: str, *overrides: str) -> None:
    """Runs a script of the project to its end."""
    run = subprocess.run(
        [sys.executable, ROOT / script, *overrides],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    if run.returncode:
        raise RuntimeError(f"{script}: {run.stderr}")


CASES: dict[str, Callable[[], Record]] = {
    **{
        f"{method}, lane_graph": partial(record_of, method, "lane_graph")
        for method in METHODS
    },
    **{f"e2, {ego}": partial(record_of, "e2", ego) for ego in EGOS},
    "search": searched,
    "training": trained,
}


def main(*names: str) -> None:
    """Writes the records of these cases, by default of all, into golden.json."""
    stored = json.loads(FILE.read_text()) if FILE.exists() and names else {"cases": {}}
    stored["processor"] = processor()
    for name in names or CASES:
        stored["cases"][name] = CASES[name]()
        print(name, stored["cases"][name], flush=True)
        FILE.write_text(json.dumps(stored, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
