"""Prior checkpoints: safetensors with architecture and origin in the header; nothing is
ever unpickled."""

import hashlib
import json
from dataclasses import asdict
from functools import partial
from importlib.resources import files
from pathlib import Path

from safetensors.torch import save

from e2rl.prior.bounds import BoundSettings
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.features import EDGE, NODE
from e2rl.prior.lane_relative import SIZE
from e2rl.prior.prior import Prior
from e2rl.prior.sde import SamplerSettings
from e2rl.run.config import settings_of
from e2rl.run.errors import InputError
from e2rl.run.files import check_format, write_atomically
from e2rl.run.weights import read_weights, unlike, weight_bytes

FORMAT = "e2rl-prior/1"
BUNDLED = "bundled"
FEATURES = [NODE, EDGE, SIZE]
LARGEST = 1 << 12  # of a network's sizes


def save_prior(prior: Prior, folder: Path, origin: dict) -> Path:
    """Write `prior-<hash of the weights>.safetensors` into folder and return its path.

    origin: what made it (command, commit, data fingerprint, settings, validation), kept
    in the header as JSON.
    """
    network = asdict(prior.denoiser.settings)
    header = {
        "format": FORMAT,
        "architecture": json.dumps({"denoiser": network, "features": FEATURES}),
        "origin": json.dumps(origin),
    }
    tensors = {
        key: value.detach().cpu().contiguous()
        for key, value in prior.state_dict().items()
    }
    mark = hashlib.sha256(save(tensors)).hexdigest()[:12]
    path = Path(folder) / f"prior-{mark}.safetensors"
    write_atomically(path, weight_bytes(tensors, header))
    return path


def load_prior(
    checkpoint: str,
    sampler: SamplerSettings | None = None,
    bounds: BoundSettings | None = None,
    device: str = "cpu",
) -> tuple[Prior, dict]:
    """The frozen prior in a checkpoint file, and its origin.

    Args:
        checkpoint: the file, the folder of the run that wrote it, or `bundled`: the one
            that comes with the package, trained on the bundled scenes alone.
        sampler: how it samples (None: the configuration's default).
        bounds: of what is executed (None: the default).
        device: where it is put.

    Raises:
        InputError: naming the file, where it is missing, damaged or of another
            architecture.
    """
    path = Path(checkpoint)
    if checkpoint == BUNDLED:
        path = Path(str(files("e2rl") / "assets" / "prior"))
    if path.is_dir():
        priors = sorted(path.glob("prior-*.safetensors"))
        if len(priors) != 1:
            raise InputError(
                f"prior.checkpoint={checkpoint}: a folder of {len(priors)} priors; give "
                "the file of one, prior-....safetensors, or the folder of a run of "
                "`python train.py stage=prior`"
            )
        (path,) = priors
    if not path.exists():
        raise InputError(
            f"prior.checkpoint={checkpoint}: no such file; train one with `python "
            f"train.py stage=prior`, or use prior.checkpoint={BUNDLED}"
        )
    try:
        tensors, header = read_weights(path)
    except ValueError as error:
        raise InputError(
            f"{path}: not a readable safetensors file ({error}); train the prior again"
        ) from error
    check_format(
        path,
        header.get("format"),
        expected=FORMAT,
        mend="train a prior by `python train.py stage=prior`, or use prior.checkpoint="
        f"{BUNDLED} (an actor is given by ego=actor ego.checkpoint=)",
    )
    try:
        architecture = json.loads(header["architecture"])
        origin = json.loads(header["origin"])
        if architecture.keys() != {"denoiser", "features"}:
            raise ValueError(f"parts {sorted(architecture)}")
        if architecture["features"] != FEATURES:
            raise ValueError(
                f"made for {architecture['features']} features, this version has "
                f"{FEATURES}"
            )
        network = architecture["denoiser"]
        settings = settings_of(DenoiserSettings, network, where="denoiser")
        if max(settings.width, settings.blocks, settings.pair) > LARGEST:
            raise ValueError(f"a size above {LARGEST} in {settings}")
        make = partial(Prior, settings, sampler, bounds)
        if wrong := unlike(make, tensors):
            raise ValueError(wrong)
        prior = make()
        prior.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, RuntimeError, InputError) as error:
        # Of torch's list of tensors that do not fit, the first.
        reason = " ".join(str(error).split("\n\t")[:2])
        raise InputError(
            f"{path}: another architecture ({reason}); train the prior again"
        ) from error
    return prior.requires_grad_(False).eval().to(device), origin
