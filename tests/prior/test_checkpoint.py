"""Checkpoints: the same prior comes back, and what does not fit is refused in a
sentence."""

import json
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import e2rl
from e2rl.prior.checkpoint import load_prior, save_prior
from e2rl.prior.sde import SamplerSettings
from e2rl.run.errors import InputError
from e2rl.run.weights import HASH, read_weights
from tests.prior.small import small_prior


def test_a_saved_prior_comes_back(tmp_path):
    prior = small_prior()
    path = save_prior(prior, tmp_path / "new", origin={"command": "x", "step": 3})
    back, origin = load_prior(str(path), SamplerSettings(steps=3))
    assert origin == {"command": "x", "step": 3}
    assert back.sampler.steps == 3
    assert back.denoiser.settings == prior.denoiser.settings
    for key, value in prior.state_dict().items():
        assert torch.equal(value, back.state_dict()[key])
    assert not any(parameter.requires_grad for parameter in back.parameters())
    assert not back.training


def test_the_folder_of_one_prior_stands_for_it(tmp_path):
    prior = small_prior()
    path = save_prior(prior, tmp_path, {"data": "one"})
    assert load_prior(str(tmp_path))[1] == load_prior(str(path))[1] == {"data": "one"}
    path.with_name("prior-other.safetensors").write_bytes(path.read_bytes())
    with pytest.raises(InputError, match="a folder of 2 priors; give the file of one"):
        load_prior(str(tmp_path))


@pytest.mark.parametrize(
    "path",
    sorted((Path(e2rl.__file__).parent / "assets").rglob("*.safetensors")),
    ids=str,
)
def test_weights_that_come_with_the_package_carry_the_hash_of_what_they_are(
    tmp_path, path
):
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    assert HASH in metadata
    assert read_weights(path)[0].keys() == tensors.keys()
    next(value for value in tensors.values() if value.is_floating_point()).view(-1)[
        0
    ] += 1e-3
    save_file(tensors, tmp_path / path.name, metadata)
    with pytest.raises(ValueError, match="not what was written"):
        read_weights(tmp_path / path.name)


def rewritten(path, change, drop=None):
    """The checkpoint with its architecture passed through `change`, without tensor
    `drop` and without its hash."""
    with safe_open(path, "pt") as file:
        metadata = dict(file.metadata())
        del metadata[HASH]
        tensors = {
            key: file.get_tensor(key)
            for key in file.keys()  # noqa: SIM118
            if key != drop
        }
    architecture = json.loads(metadata["architecture"])
    change(architecture)
    save_file(tensors, path, metadata | {"architecture": json.dumps(architecture)})
    return str(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda a: a["denoiser"].update(width=16),
        lambda a: a["denoiser"].update(width=96 * 10**6),
        lambda a: a.update(free_space=True),
    ],
    ids=["width", "endless-width", "without-lanes"],
)
def test_another_architecture_is_refused(tmp_path, change):
    path = rewritten(save_prior(small_prior(), tmp_path, origin={}), change)
    with pytest.raises(InputError, match="prior-"):
        load_prior(path)


def test_missing_damaged_foreign_and_incomplete_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_prior(str(tmp_path / "none.safetensors"))
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(b"not a checkpoint")
    with pytest.raises(InputError, match="broken"):
        load_prior(str(broken))
    foreign = tmp_path / "foreign.safetensors"
    save_file({"x": torch.zeros(1)}, foreign)
    with pytest.raises(InputError, match="format"):
        load_prior(str(foreign))
    path = rewritten(
        save_prior(small_prior(), tmp_path, origin={}),
        lambda a: None,
        drop="denoiser.head.1.bias",
    )
    with pytest.raises(InputError, match="head"):
        load_prior(path)
