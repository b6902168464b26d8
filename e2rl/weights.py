"""Weights in safetensors files, with a hash of what was written in the header: an altered file is noticed.

Files of earlier versions have no hash; of those only the form is checked.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

HASH = "sha256"  # key of the header


def weight_bytes(weights: Mapping[str, Tensor], header: Mapping[str, str]) -> bytes:
    """The content of a file with weights, header and hash: equal weights make equal bytes."""
    plain = {key: value.detach().cpu().contiguous() for key, value in weights.items()}
    return _in_order(save(plain, {**header, HASH: _digest(plain, header)}))


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Weights and header, without the hash, of a safetensors file; ValueError where it is none, where it is not what
    was written, and where a weight is NaN or infinite."""
    try:
        with safe_open(path, "pt") as file:
            header = dict(file.metadata() or {})
            weights = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, OSError, UnicodeError) as error:
        raise ValueError(str(error)) from error
    written = header.pop(HASH, None)
    if written is not None and written != _digest(weights, header):
        raise ValueError("its content is not what was written")
    bad = [key for key, value in weights.items() if value.is_floating_point() and not bool(value.isfinite().all())]
    if bad:
        raise ValueError(f"{bad[0]} holds NaN or infinite values")
    return weights, header


def unlike(make: Callable[[], nn.Module], weights: Mapping[str, Tensor]) -> str | None:
    """What in the weights has another name or shape than in a network, of which nothing is allocated; None: nothing."""
    with torch.device("meta"):
        own = make().state_dict()
    if other := sorted(set(own) ^ set(weights)):
        return f"{other[0]} is {'missing' if other[0] in own else 'unknown'}"
    wrong = (name for name, value in own.items() if value.shape != weights[name].shape)
    return next(
        (f"{name} has shape {tuple(weights[name].shape)}, not {tuple(own[name].shape)}" for name in wrong), None
    )


def _in_order(content: bytes) -> bytes:
    """A safetensors file with its header's keys in order, which safetensors shuffles."""
    end = 8 + int.from_bytes(content[:8], "little")
    head = json.dumps(json.loads(content[8:end]), sort_keys=True, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 8)  # the tensors stay aligned
    return len(head).to_bytes(8, "little") + head + content[end:]


def _digest(weights: Mapping[str, Tensor], header: Mapping[str, str]) -> str:
    """SHA-256 of the header and of every tensor's name, type, shape and bytes."""
    digest = hashlib.sha256(repr(sorted(header.items())).encode())
    for key, value in sorted(weights.items()):
        digest.update(f"{key} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
