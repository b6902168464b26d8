"""Training the prior: windows over whole logs, validation on held-out places, best checkpoint kept, exact resume."""

import json
import platform
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from e2rl.learning.prior_training.distributed import ALONE, Processes
from e2rl.learning.prior_training.loss import held_out_loss
from e2rl.learning.prior_training.optimisation import PriorTraining
from e2rl.learning.prior_training.training_settings import TrainingSettings
from e2rl.learning.prior_training.windows import STANDING_WEIGHT, make_windows
from e2rl.prior.checkpoint import save_prior
from e2rl.prior.prior import Prior
from e2rl.prior.routes import candidate_features
from e2rl.run.errors import InputError
from e2rl.run.files import write_atomically
from e2rl.run.parts import read_state, state_bytes
from e2rl.scenes.scene import SceneSet

HELD_OUT = 8  # one in HELD_OUT places is held out for validation
STATE, PREVIOUS, PROGRESS = "training.pt", "training.previous.pt", "progress.jsonl"

ClosedLoop = Callable[[Prior], dict[str, float]]  # metrics of a prior that drives held-out scenes


def train_route_choice(prior: Prior, scenes: TensorDictBase, settings: TrainingSettings) -> float:
    """Train by cross-entropy on the driven candidate, over vehicles with several; returns the training accuracy."""
    device = next(prior.route_choice.parameters()).device
    features = torch.cat([candidate_features(part) for part in scenes.split(64)])
    valid, label = scenes["route_valid"], scenes["route_log"]
    use = scenes["valid"][:, : label.shape[1]] & ~scenes["parked"][:, : label.shape[1]] & (label >= 0)
    use &= valid.sum(-1) > 1
    features, valid, label = (value[use].to(device) for value in (features, valid, label))
    if not len(label):
        return float("nan")
    generator = torch.Generator().manual_seed(settings.seed)
    optimiser = torch.optim.AdamW(prior.route_choice.parameters(), 3e-3, weight_decay=0.05)
    for _ in tqdm(range(settings.route_steps), "route choice", disable=None):
        pick = torch.randint(len(label), (512,), generator=generator).to(device)
        sample = features[pick]
        sample = sample + 0.05 * torch.randn(sample.shape, generator=generator).to(device)
        logits = prior.route_choice.net(sample)[..., 0].masked_fill(~valid[pick], -1e4)
        loss = F.cross_entropy(logits, label[pick])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        logits = prior.route_choice.net(features)[..., 0].masked_fill(~valid, -torch.inf)
    return (logits.argmax(-1) == label).float().mean().item()


def held_out(scenes: SceneSet) -> Tensor:
    """[S] bool: scenes of held-out places (without places: of held-out logs). Raises InputError if all are."""
    names = zip(scenes.location, scenes.scene_id, strict=True)
    places = [location or scene_id.split("@")[0] for location, scene_id in names]
    chosen = set(sorted(set(places))[::HELD_OUT])
    mask = torch.tensor([name in chosen for name in places])
    if bool(mask.all()):
        where = f"all {len(scenes)} scenes are of one place ({places[0]!r})"
        raise InputError(f"{where}, so none can be held out for validation; train on logs of several places")
    return mask


def window_sets(scenes: SceneSet) -> tuple[TensorDictBase, TensorDictBase]:
    """(training, held-out) windows. Raises InputError if either is empty or has no moving vehicle."""
    mask = held_out(scenes)
    windows, test = (make_windows(scenes.batch(part.nonzero()[:, 0])) for part in (~mask, mask))
    if not len(windows) or not len(test):
        counts = f"{len(windows)} training and {len(test)} held-out windows of {len(scenes)} scenes"
        reason = "too few vehicles are recorded for a second on a known route"
        raise InputError(f"{counts}: {reason}; train on more or longer logs")
    for name, part in (("training", windows), ("held-out", test)):
        if not bool((part["weight"] > STANDING_WEIGHT).any()):
            where = f"in the {len(part)} {name} windows of {len(scenes)} scenes"
            raise InputError(f"no vehicle moves {where}; train on logs with moving traffic")
    return windows, test


@dataclass
class Record:
    """The record of a run: validations so far (lines of progress.jsonl), loss, step and weights of the best one,
    accuracy of the route choice, and wall seconds of each stage over all interruptions."""

    lines: list[dict] = field(default_factory=list)
    best: dict = field(default_factory=lambda: {"held_out": float("inf"), "step": 0, "weights": None})
    accuracy: float = float("nan")
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the wall seconds of the block to those of a stage."""
        begin = time.perf_counter()
        yield
        self.seconds[stage] = round(self.seconds.get(stage, 0.0) + time.perf_counter() - begin, 1)

    def add(self, line: dict, prior: Prior) -> None:
        """Add a validation of `prior`; keep its weights if its held-out loss is the lowest.

        Only the loss selects: thousands of windows at fixed noise make it precise. Closed-loop metrics on a few scenes
        are only reported: their noise exceeds the differences between checkpoints (conf/prior/default.yaml).
        """
        self.lines.append(line)
        if line["held_out"] < self.best["held_out"]:
            weights = {key: value.detach().cpu().clone() for key, value in prior.state_dict().items()}
            self.best = {"held_out": line["held_out"], "step": line["step"], "weights": weights}

    def summary(self) -> str:
        """The last validation in one line."""
        line, best = self.lines[-1], self.best
        text = f"step {line['step']}: held-out loss {line['held_out']:.4f} "
        text += f"(best {best['held_out']:.4f} at {best['step']})"
        losses = ("step", "held_out", "action", "trajectory")
        figures = [f"{key} {value:.4f}" for key, value in line.items() if key not in losses]
        return text + ("; closed loop " + ", ".join(figures) if figures else "")

    def write(self, folder: Path, run: dict, fingerprint: str) -> None:
        """Write progress.jsonl, and training.pt with the run's state."""
        state = {"run": run, "record": vars(self), "fingerprint": fingerprint}
        write_atomically(folder / PROGRESS, "".join(json.dumps(line) + "\n" for line in self.lines))
        content = state_bytes(state)
        if (folder / STATE).exists():
            (folder / STATE).replace(folder / PREVIOUS)
        write_atomically(folder / STATE, content)


def saved_state(folder: Path) -> dict | None:
    """The newest whole state that an interrupted run has written, None where it has written none.

    Raises InputError where all are damaged.
    """
    found = [folder / name for name in (STATE, PREVIOUS) if (folder / name).exists()]
    for file in found:
        try:
            return read_state(file)
        except ValueError as error:
            tqdm.write(f"passed over: {error}", sys.stderr)
    if found:
        raise InputError(f"{found[0]}: damaged, and no whole one before it; begin a new run")
    return None


def train_prior(
    prior: Prior,
    scenes: SceneSet,
    settings: TrainingSettings,
    folder: Path,
    origin: dict,
    closed_loop: ClosedLoop | None = None,
    processes: Processes = ALONE,
) -> Path | None:
    """Train `prior` on scenes and return the path of the best checkpoint (by held-out loss of the averaged weights);
    None in processes other than the leader.

    folder: holds training.pt, from which an interrupted run resumes exactly, progress.jsonl and the checkpoint. origin:
    data and command, for the checkpoint's header, which also holds the results of the training. closed_loop: metrics
    that every `closed_loop_every`-th validation and the last one report beside the held-out loss. Raises InputError if
    the interrupted run had other data, or for too few scenes.
    """
    record, data = Record(), origin.get("fingerprint", "")
    state = saved_state(folder)
    if state is not None:
        if state.get("fingerprint") != data:
            raise InputError(f"{folder / STATE}: the interrupted run had other data; resume with the same scenes")
        record = Record(**state["record"])
    with record.timed("windows"):
        windows, test = window_sets(scenes)
    if state is None:
        with record.timed("routes"):
            record.accuracy = train_route_choice(prior, scenes.batch((~held_out(scenes)).nonzero()[:, 0]), settings)
    run = PriorTraining(prior, windows, settings, processes)
    if state is not None:
        run.load_state_dict(state["run"])
    while run.step < settings.steps:
        with record.timed("steps"):
            losses = run.run(min(run.step + settings.validate_every, settings.steps))
        with record.timed("validation"), run.averaged():
            if processes.leader:
                record.add(_validate(run, test, losses, closed_loop), prior)
                tqdm.write(record.summary())
        state = run.state_dict()
        if processes.leader:
            record.write(folder, state, data)
    if not processes.leader:
        return None
    return _checkpoint(run, record, folder, origin | {"windows": len(windows), "held_out_windows": len(test)})


def _validate(
    run: PriorTraining, test: TensorDictBase, losses: dict[str, float], closed_loop: ClosedLoop | None
) -> dict[str, float]:
    """Held-out loss, training losses and, if due, closed-loop metrics."""
    settings = run.settings
    line = {"step": run.step, "held_out": held_out_loss(run.prior, test, settings), **losses}
    number, last = -(-run.step // settings.validate_every), run.step == settings.steps
    every = settings.closed_loop_every
    if closed_loop is not None and every and (last or number % every == 0):
        line |= closed_loop(run.prior)
    return line


def _checkpoint(run: PriorTraining, record: Record, folder: Path, origin: dict) -> Path:
    """Write the best weights, with their origin in the header."""
    best = record.best
    run.prior.load_state_dict(best["weights"])
    seconds = origin.get("seconds", {}) | record.seconds
    seconds["total"] = round(sum(seconds.values()), 1)
    tqdm.write("seconds: " + ", ".join(f"{stage} {value:.0f}" for stage, value in seconds.items()))
    results = {
        "validation": next(line for line in record.lines if line["step"] == best["step"]),
        "held_out_loss": best["held_out"],
        "step": best["step"],
        "route_accuracy": record.accuracy,
        "processes": run.processes.count,
        "device": str(run.device),
        "versions": {"python": platform.python_version(), "torch": torch.__version__},
        "seconds": seconds,
    }
    return save_prior(run.prior.eval(), folder, origin | results)
