"""Weights in safetensors files, with a hash of what was written in the header: an
altered file is noticed. Of files without a hash only the form is checked."""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

HASH = "sha256"  # key in the header


def weight_bytes(weights: Mapping[str, Tensor], header: Mapping[str, str]) -> bytes:
    """Returns the content of a file with weights, header and hash: equal weights make
    equal bytes."""
    plain = {key: value.detach().cpu().contiguous() for key, value in weights.items()}
    content = save(plain, {**header, HASH: _digest(plain, header)})
    # safetensors shuffles the keys of its header
    end = 8 + int.from_bytes(content[:8], "little")
    entries = json.loads(content[8:end])
    head = json.dumps(entries, sort_keys=True, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 8)  # the tensors stay aligned
    return len(head).to_bytes(8, "little") + head + content[end:]


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Returns weights and header, without the hash, of a safetensors file; ValueError
    where it is none, where it is not what was written, and where a weight is NaN or
    infinite."""
    try:
        with safe_open(path, "pt") as file:
            header = dict(file.metadata() or {})
            names = list(file.keys())
            weights = {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError, UnicodeError) as error:
        raise ValueError(str(error)) from error
    written = header.pop(HASH, None)
    if written is not None and written != _digest(weights, header):
        raise ValueError("its content is not what was written")
    for name, value in weights.items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise ValueError(f"{name} holds NaN or infinite values")
    return weights, header


def unlike(make: Callable[[], nn.Module], weights: Mapping[str, Tensor]) -> str | None:
    """Returns what in the weights has another name or shape than in a network, of which
    nothing is allocated; None: nothing."""
    with torch.device("meta"):
        expected = make().state_dict()
    for name in sorted(set(expected) ^ set(weights)):
        return f"{name} is {'missing' if name in expected else 'unknown'}"
    for name, value in expected.items():
        shape = tuple(weights[name].shape)
        if shape != tuple(value.shape):
            return f"{name} has shape {shape}, not {tuple(value.shape)}"
    return None


def _digest(weights: Mapping[str, Tensor], header: Mapping[str, str]) -> str:
    """SHA-256 of the header and of every tensor's name, type, shape and bytes."""
    digest = hashlib.sha256(repr(sorted(header.items())).encode())
    for key, value in sorted(weights.items()):
        digest.update(f"{key} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
