"""Training the prior: windows over whole logs, moving average of the weights, best checkpoint kept, exact resume."""

import json
import time
from contextlib import contextmanager
from pathlib import Path

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tqdm import tqdm

from e2rl.errors import InputError
from e2rl.prior.checkpoint import save_prior
from e2rl.prior.loss import TrainingSettings, augment, denoising_loss, held_out_loss
from e2rl.prior.prior import Prior
from e2rl.prior.route_choice import candidate_features
from e2rl.prior.windows import make_windows
from e2rl.scene.scene import SceneSet

HELD_OUT = 8  # one place in so many is held out for validation


def train_route_choice(prior: Prior, scenes: TensorDictBase, settings: TrainingSettings) -> float:
    """Cross-entropy on the candidate driven, over vehicles with a choice; returns the accuracy on the training set."""
    parts = [candidate_features(scenes[i:i + 64]) for i in range(0, len(scenes), 64)]
    device = next(prior.route_choice.parameters()).device
    features = torch.cat(parts)
    valid, label = scenes["route_valid"], scenes["route_log"]
    use = scenes["valid"][:, :label.shape[1]] & ~scenes["parked"][:, :label.shape[1]] & (label >= 0)
    use &= valid.sum(-1) > 1
    use[:, 0] &= label[:, 0] >= 0
    features, valid, label = (value[use].to(device) for value in (features, valid, label))
    if not len(label):
        return float("nan")
    generator = torch.Generator().manual_seed(settings.seed)
    optimiser = torch.optim.AdamW(prior.route_choice.parameters(), 3e-3, weight_decay=0.05)
    for _ in tqdm(range(settings.route_steps), "route choice"):
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


class PriorTraining:
    """The state of one training run: network, its moving average, optimiser, progress and generator."""

    def __init__(self, prior: Prior, windows: TensorDictBase, settings: TrainingSettings):
        self.prior, self.windows, self.settings, self.step = prior, windows, settings, 0
        self.device = next(prior.parameters()).device
        self.generator = torch.Generator(self.device).manual_seed(settings.seed)
        nodes = windows["nodes"][windows["present"]]
        prior.denoiser.node_mean.copy_(nodes.mean(0))
        prior.denoiser.node_std.copy_(nodes.std(0).clamp(min=0.02))
        self.optimiser = torch.optim.AdamW(prior.denoiser.parameters(), settings.learning_rate,
                                           weight_decay=settings.weight_decay)
        self.average = {key: value.clone() for key, value in prior.denoiser.state_dict().items()}

    def learning_rate(self) -> float:
        """Linear warm-up over 50 steps, then a cosine to 0."""
        warm = min(1.0, (self.step + 1) / 50)
        done = torch.tensor(self.step / self.settings.steps * torch.pi)
        return self.settings.learning_rate * warm * 0.5 * (1 + torch.cos(done).item())

    def run(self, until: int) -> dict[str, float]:
        """Train up to step `until`; returns the running losses."""
        running: dict[str, float] = {}
        self.prior.train()
        bar = tqdm(range(self.step, until), "prior", initial=self.step, total=self.settings.steps, unit="step")
        for _ in bar:
            pick = torch.randint(len(self.windows), (self.settings.batch,), generator=self.generator,
                                 device=self.device).to(self.windows["x0"].device)
            batch = augment(self.windows[pick].to(self.device), self.settings, self.generator)
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.bf16):
                loss, parts = denoising_loss(self.prior, batch, self.settings, self.generator)
            for group in self.optimiser.param_groups:
                group["lr"] = self.learning_rate()
            self.optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.prior.denoiser.parameters(), 1.0)
            self.optimiser.step()
            self.step += 1
            decay = min(self.settings.ema, (1 + self.step) / (10 + self.step))
            for key, value in self.prior.denoiser.state_dict().items():
                self.average[key].lerp_(value, 1 - decay)
            if self.step % 20 == 0:
                for key, value in parts.items():
                    running[key] = 0.9 * running.get(key, value.item()) + 0.1 * value.item()
                bar.set_postfix({key: f"{value:.3f}" for key, value in running.items()})
        return running

    @contextmanager
    def averaged(self):
        """Within this context the prior holds the averaged weights."""
        raw = {key: value.clone() for key, value in self.prior.denoiser.state_dict().items()}
        self.prior.denoiser.load_state_dict(self.average)
        self.prior.eval()
        try:
            yield self.prior
        finally:
            self.prior.denoiser.load_state_dict(raw)

    def state_dict(self) -> dict:
        """Everything that exact resumption needs."""
        return {"denoiser": self.prior.denoiser.state_dict(), "route_choice": self.prior.route_choice.state_dict(),
                "average": self.average, "optimiser": self.optimiser.state_dict(), "step": self.step,
                "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict) -> None:
        """Go on from a `state_dict`."""
        self.prior.denoiser.load_state_dict(state["denoiser"])
        self.prior.route_choice.load_state_dict(state["route_choice"])
        self.average = {key: value.to(self.device, copy=True) for key, value in state["average"].items()}
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = state["step"]
        self.generator.set_state(state["generator"].cpu())


def held_out(scenes: SceneSet) -> torch.Tensor:
    """[S] bool: scenes of the places (or, without places, the logs) that are held out."""
    place = [location or scene_id.split("@")[0]
             for location, scene_id in zip(scenes.location, scenes.scene_id, strict=True)]
    chosen = set(sorted(set(place))[::HELD_OUT])
    mask = torch.tensor([name in chosen for name in place])
    if bool(mask.all()):
        raise InputError(f"all {len(scenes)} scenes are of one place ({place[0]!r}), so none can be held out for "
                         "validation; train on logs of several places")
    return mask


def train_prior(prior: Prior, scenes: SceneSet, settings: TrainingSettings, validate_every: int, folder: Path,
                origin: dict) -> Path:
    """Train `prior` on scenes and return the path of the best checkpoint (by held-out loss of the averaged weights).

    folder: holds training.pt, from which an interrupted run goes on exactly, progress.jsonl and the checkpoint.
    """
    begin, mask = time.perf_counter(), held_out(scenes)
    windows = make_windows(scenes.scenes[~mask], prior.free_space)
    test = make_windows(scenes.scenes[mask], prior.free_space)
    if not len(windows) or not len(test):
        raise InputError(f"{len(windows)} training and {len(test)} held-out windows of {len(scenes)} scenes: too few "
                         "vehicles are recorded for a second on a known route; train on more or longer logs")
    origin = origin | {"windows": len(windows), "held_out_windows": len(test)}
    torch.manual_seed(settings.seed)
    accuracy = train_route_choice(prior, scenes.scenes[~mask], settings)
    run, best = PriorTraining(prior, windows, settings), {"loss": float("inf"), "weights": None, "step": 0}
    state_file = folder / "training.pt"
    if state_file.exists():
        saved = torch.load(state_file, map_location="cpu", weights_only=True)
        run.load_state_dict(saved["run"])
        best = saved["best"]
    while run.step < settings.steps:
        losses = run.run(min(run.step + validate_every, settings.steps))
        with run.averaged():
            loss = held_out_loss(prior, test, settings)
            if loss < best["loss"]:
                weights = {key: value.clone() for key, value in prior.state_dict().items()}
                best = {"loss": loss, "weights": weights, "step": run.step}
        tqdm.write(f"step {run.step}: held-out loss {loss:.4f} (best {best['loss']:.4f} at {best['step']})")
        with (folder / "progress.jsonl").open("a") as file:
            file.write(json.dumps({"step": run.step, "held_out": loss, **losses}) + "\n")
        part = state_file.with_suffix(".part")
        torch.save({"run": run.state_dict(), "best": best}, part)
        part.replace(state_file)
    prior.load_state_dict(best["weights"])
    return save_prior(prior, folder, origin | {
        "held_out_loss": best["loss"], "step": best["step"], "route_accuracy": accuracy,
        "seconds": round(time.perf_counter() - begin, 1)})
