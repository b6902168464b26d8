"""Weights read back are those written, and an altered file is noticed."""

import random

import pytest
import torch
from safetensors.torch import save

from e2rl.planners.actor import ActorEgo
from e2rl.planners.bits_network import BitsNetwork, load_bits, save_bits
from e2rl.prior.checkpoint import load_prior, save_prior
from e2rl.run.errors import InputError
from e2rl.run.files import HASH, read_weights, weight_bytes
from tests.prior.small import small_prior

WEIGHTS = {"a": torch.arange(12.0).view(3, 4), "b": torch.tensor(3), "c": torch.zeros(0, 2, dtype=torch.float64)}


def test_what_is_written_is_read_without_the_hash(tmp_path):
    path = tmp_path / "x.safetensors"
    path.write_bytes(weight_bytes(WEIGHTS, {"architecture": "small"}))
    weights, header = read_weights(path)
    assert header == {"architecture": "small"} and set(weights) == set(WEIGHTS)
    assert all(torch.equal(value, WEIGHTS[key]) and value.dtype == WEIGHTS[key].dtype for key, value in weights.items())


def test_equal_weights_make_equal_bytes():
    header = {"architecture": "small", "kind": "actor", "version": "1"}
    assert len({weight_bytes(dict(WEIGHTS), dict(header)) for _ in range(20)}) == 1


@pytest.mark.parametrize("seed", range(20))
def test_a_flipped_bit_changes_no_weight_in_silence(tmp_path, seed):
    """It is noticed wherever it is but in the name of the hash, where it changes nothing else."""
    content, draw = bytearray(weight_bytes(WEIGHTS, {"architecture": "small"})), random.Random(seed)
    content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    (tmp_path / "x.safetensors").write_bytes(content)
    try:
        weights, header = read_weights(tmp_path / "x.safetensors")
    except ValueError:
        return
    assert HASH.encode() not in content and header["architecture"] == "small"
    assert all(torch.equal(value, WEIGHTS[key]) for key, value in weights.items())


def test_files_without_a_hash_are_read_but_not_with_nan(tmp_path):
    path = tmp_path / "x.safetensors"
    path.write_bytes(save(WEIGHTS, {"architecture": "small"}))
    assert read_weights(path)[1] == {"architecture": "small"} and HASH not in read_weights(path)[1]
    path.write_bytes(weight_bytes(WEIGHTS | {"a": torch.tensor([1.0, torch.nan])}, {}))
    with pytest.raises(ValueError, match="a holds NaN"):
        read_weights(path)


def actor(folder, path=None):
    network = ActorEgo(hidden=(8,)).network
    network.save(folder / "actor.safetensors") if path is None else network.load(path)
    return folder / "actor.safetensors"


def bits(folder, path=None):
    save_bits(BitsNetwork(8), folder / "bits.safetensors", {}) if path is None else load_bits(str(path))
    return folder / "bits.safetensors"


def prior(folder, path=None):
    return save_prior(small_prior(), folder, {}) if path is None else load_prior(str(path))


@pytest.mark.parametrize("kind", [actor, bits, prior])
def test_checkpoints_with_a_flipped_bit_are_refused_by_name(tmp_path, kind):
    path = kind(tmp_path)
    kind(tmp_path, path)
    content = bytearray(path.read_bytes())
    content[-3] ^= 4
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"{path.name}.*not what was written"):
        kind(tmp_path, path)
