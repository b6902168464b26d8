"""Prior checkpoints: safetensors with the architecture and the origin in the header; nothing is ever unpickled."""

import hashlib
import json
import os
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from e2rl.errors import InputError
from e2rl.prior.bounds import BoundSettings
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.features import EDGE, NODE
from e2rl.prior.lane_relative import SIZE
from e2rl.prior.prior import Prior, SamplerSettings

FORMAT = "e2rl-prior/1"
BUNDLED = "bundled"


def save_prior(prior: Prior, folder: Path, origin: dict) -> Path:
    """Write `prior-<content hash>.safetensors` into folder and return its path.

    origin: what made it (command, commit, data fingerprint, settings, validation), kept in the header as JSON.
    """
    architecture = {
        "denoiser": asdict(prior.denoiser.settings),
        "free_space": prior.free_space,
        "features": [NODE, EDGE, SIZE],
    }
    metadata = {"format": FORMAT, "architecture": json.dumps(architecture), "origin": json.dumps(origin)}
    tensors = {key: value.detach().cpu().contiguous() for key, value in prior.state_dict().items()}
    content = save(tensors, metadata)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"prior-{hashlib.sha256(save(tensors)).hexdigest()[:12]}.safetensors"
    part = path.with_suffix(f".{os.getpid()}.part")
    part.write_bytes(content)
    part.replace(path)
    return path


def load_prior(
    checkpoint: str, sampler: SamplerSettings | None = None, bounds: BoundSettings | None = None, device: str = "cpu"
) -> tuple[Prior, dict]:
    """The frozen prior in a checkpoint file (or `bundled`), and its origin.

    Raises InputError naming the file where it is missing, damaged or of another architecture.
    """
    path = bundled_checkpoint() if checkpoint == BUNDLED else Path(checkpoint)
    if not path.exists():
        raise InputError(
            f"prior.checkpoint={checkpoint}: no such file; train one with `python train.py stage=prior`, "
            f"or use prior.checkpoint={BUNDLED}"
        )
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path}: not a readable safetensors file ({error}); train the prior again") from error
    if metadata.get("format") != FORMAT:
        raise InputError(f"{path}: format {metadata.get('format')!r}, expected {FORMAT!r}; is it a prior checkpoint?")
    try:
        architecture, origin = json.loads(metadata["architecture"]), json.loads(metadata["origin"])
        made_for, denoiser = architecture["features"], DenoiserSettings(**architecture["denoiser"])
        free_space = architecture["free_space"]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: another architecture (its header: {error}); train the prior again") from error
    if made_for != [NODE, EDGE, SIZE]:
        raise InputError(
            f"{path}: made for {made_for} features, this version has {[NODE, EDGE, SIZE]}; train the "
            "prior again with `python train.py stage=prior`"
        )
    prior = Prior(denoiser, sampler, bounds, free_space)
    expected = {key: value.shape for key, value in prior.state_dict().items()}
    wrong = [
        key
        for key in expected.keys() | tensors.keys()
        if key not in tensors or key not in expected or tensors[key].shape != expected[key]
    ]
    if wrong:
        raise InputError(f"{path}: another architecture ({sorted(wrong)[0]} does not fit); train the prior again")
    prior.load_state_dict(tensors)
    return prior.requires_grad_(False).eval().to(device), origin


def bundled_checkpoint() -> Path:
    """The checkpoint shipped with the package, trained on the bundled scenes alone."""
    found = sorted(Path(str(files("e2rl") / "assets" / "prior")).glob("prior-*.safetensors"))
    if not found:
        raise InputError("the package holds no bundled prior; reinstall it, or pass prior.checkpoint=FILE")
    return found[-1]
