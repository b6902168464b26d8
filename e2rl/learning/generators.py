"""The global generators of random numbers, for runs that go on exactly."""

import random

import numpy as np
import torch


def generator_states() -> dict:
    """States of the global generators of torch, CUDA, numpy and python, as plain values
    and tensors."""
    state = np.random.get_state()
    assert isinstance(state, tuple)  # the global generator is a Mersenne Twister
    name, keys, position, has_gauss, cached = state
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "numpy": [name, keys.tolist(), position, has_gauss, cached],
        "python": list(random.getstate()),
    }


def restore_generators(states: dict) -> None:
    """Set the global generators to `generator_states`."""
    torch.set_rng_state(states["torch"])
    if torch.cuda.is_available() and states["cuda"]:
        torch.cuda.set_rng_state_all(states["cuda"])
    name, keys, position, has_gauss, cached = states["numpy"]
    np.random.set_state(
        (name, np.array(keys, dtype=np.uint32), position, has_gauss, cached)
    )
    version, internal, gauss = states["python"]
    random.setstate((version, tuple(internal), gauss))
