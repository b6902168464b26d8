"""Formats of the files that stay: one of another format is refused in one line that
names it, one from before formats had names is read, and a format's layout never changes
under its name (docs/reference/api.md)."""

import ast
import hashlib
import json
import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest
import torch
from safetensors import safe_open

from e2rl.evaluation import attack_set, modes, rates, rollout_files, transfer, tuning
from e2rl.evaluation.attack_set import ATTACK, AttackSet
from e2rl.evaluation.rates import EgoRates
from e2rl.evaluation.rollout_files import read_rows, write_rows
from e2rl.planners import bits_network, network, policy_file
from e2rl.planners.actor import ActorEgo
from e2rl.planners.bits_network import BitsNetwork, load_bits, save_bits
from e2rl.planners.network import Architecture, read_actor
from e2rl.planners.policy_file import open_policy, write_policy
from e2rl.prior import checkpoint as prior_file
from e2rl.prior.checkpoint import load_prior, save_prior
from e2rl.report.export import archive
from e2rl.run import run
from e2rl.run.errors import InputError
from e2rl.run.parts import read_state, state_bytes
from e2rl.run.weights import HASH, weight_bytes
from e2rl.scenes import scene_list
from e2rl.scenes.scene import KEYS
from e2rl.search import tries_file
from e2rl.sim import rollout_file
from e2rl.sim.observation import observation_layout
from e2rl.sim.rollout_file import Rollout
from e2rl.traffic.attack_replay import AttackTracks
from tests.evaluation.attack_sets import attack_set as attacks
from tests.evaluation.test_tuning import tried
from tests.metrics.random_rollouts import random_rollouts
from tests.prior.small import small_prior
from tests.run.test_run import begin


class Acts(torch.nn.Module):
    """A policy that does nothing."""

    def forward(self, observation):
        return 0 * observation[:, :2]


def rewritten(path, form):
    """Writes a file again with another format in the place where its kind says it;
    None: as if it had none."""
    if path.suffix == ".npz":
        with np.load(path) as archive:
            arrays = dict(archive)
        np.savez(path, **arrays | {"format": np.array(form)})
    elif path.suffix == ".safetensors":
        with safe_open(path, "pt") as file:
            header = dict(file.metadata())
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        del header[HASH], header["format"]
        header |= {"format": form} if form else {}
        path.write_bytes(weight_bytes(weights, header))
    elif path.suffix == ".attacks":
        path.write_bytes(state_bytes(read_state(path) | {"format": form}))
    elif path.suffix == ".pt":
        module = torch.jit.load(path)
        torch.jit.save(module, path, _extra_files={"format": form} if form else {})
    else:
        content = json.loads(path.read_text())
        del content["format"]
        content |= {"format": form} if form else {}
        path.write_text(json.dumps(content))


def contents(value):
    """What was read, as text: the weights of a network, else the value itself."""
    if isinstance(value, torch.nn.Module):
        return str(value.state_dict())
    return repr(value)


def prior_of(folder):
    return save_prior(small_prior(), folder, origin={})


def actor_of(folder):
    path = folder / "actor.safetensors"
    ActorEgo(hidden=(8,)).network.save(path)
    return path


def bits_of(folder):
    save_bits(BitsNetwork(8), folder / "bits.safetensors", origin={})
    return folder / "bits.safetensors"


def policy_of(folder):
    write_policy(Acts(), folder / "policy.pt")
    return folder / "policy.pt"


def study_of(folder):
    tried(file=folder / "study.json")
    return folder / "study.json"


def run_of(folder):
    begin(folder)
    write_rows(folder / "rollouts.csv", [])
    return folder / run.PROVENANCE


KINDS = {
    rollout_file.FORMAT: (
        lambda folder: random_rollouts(1).to_npz(folder)[0],
        Rollout.read,
    ),
    attack_set.FORMAT: (
        lambda folder: attacks().write(folder / "a.attacks"),
        AttackSet.read,
    ),
    prior_file.FORMAT: (prior_of, lambda path: load_prior(str(path))),
    network.FORMAT: (actor_of, read_actor),
    bits_network.FORMAT: (bits_of, lambda path: load_bits(str(path))),
    policy_file.FORMAT: (policy_of, lambda path: open_policy(path, str(path))),
    tuning.FORMAT: (study_of, lambda path: tried(file=path)),
    run.FORMAT: (run_of, lambda path: read_rows(path.with_name("rollouts.csv"))),
}
DIGESTS = {  # of the layouts
    "e2rl-run/1": "1e5ae59c",
    "e2rl-rollout/1": "e8792fb7",
    "e2rl-attacks/1": "64db62b7",
    "e2rl-prior/1": "5d5b6a6f",
    "e2rl-actor/1": "5f537389",
    "e2rl-bits/1": "ec1f4f67",
    "e2rl-policy/1": "c59a9514",
    "e2rl-study/1": "389cbc28",
    "e2rl-scene/1": "1297e863",
}
UNNAMED = (network.FORMAT, policy_file.FORMAT, tuning.FORMAT, run.FORMAT)


@pytest.mark.parametrize("name", KINDS)
def test_a_file_of_another_format_is_refused_in_one_line_that_names_it(tmp_path, name):
    write, read = KINDS[name]
    path = write(tmp_path)
    read(path)
    older = f"{name.partition('/')[0]}/0"
    rewritten(path, older)
    with pytest.raises(InputError) as refused:
        read(path)
    said = str(refused.value)
    assert "\n" not in said
    assert str(path) in said
    assert f"of format {older}, e2rl 0.1.0 reads {name}; " in said


@pytest.mark.parametrize("name", UNNAMED)
def test_a_file_from_before_formats_had_names_is_read(tmp_path, name):
    write, read = KINDS[name]
    path = write(tmp_path)
    content = contents(read(path))
    rewritten(path, None)
    assert contents(read(path)) == content


def test_the_tables_of_a_part_of_a_run_are_of_the_run_s_format(tmp_path):
    path = run_of(tmp_path)
    (tmp_path / "before").mkdir()
    (tmp_path / "before" / rates.RATES_FILE).write_text("[]")
    assert EgoRates.read(tmp_path / "before") == []
    rewritten(path, "e2rl-run/0")
    with pytest.raises(
        InputError, match="of format e2rl-run/0, .* read it with e2rl 0"
    ):
        EgoRates.read(tmp_path / "before")


def built_in_columns():
    """The columns of rollouts.csv in a fresh process, where no test has registered
    metrics."""
    code = (
        "from e2rl.evaluation.rollout_files import table_columns; "
        "print(table_columns())"
    )
    command = [sys.executable, "-c", code]
    fresh = subprocess.run(command, capture_output=True, text=True, check=True)
    return ast.literal_eval(fresh.stdout)


def names_of(kind):
    """The fields of a dataclass."""
    return [entry.name for entry in fields(kind)]


def test_the_layout_of_a_format_does_not_change_under_its_name():
    """Where a layout changes, raise its FORMAT, read or refuse the one before, and say
    so in CHANGELOG.md; this may happen with a minor version only."""
    seen = observation_layout()
    layouts = {
        run.FORMAT: [
            *(run.PROVENANCE_SHAPE, built_in_columns(), tries_file.COLUMNS),
            *(rollout_files.METRICS_ROW, rollout_files.SOMETIMES, modes.SHAPE),
            *(rates.ENTRY, transfer.MATRIX, scene_list.COLUMNS),
        ],
        rollout_file.FORMAT: [(e.name, *e.metadata.values()) for e in fields(Rollout)],
        attack_set.FORMAT: [ATTACK, names_of(AttackSet), names_of(AttackTracks)],
        prior_file.FORMAT: [prior_file.FEATURES, sorted(small_prior().state_dict())],
        network.FORMAT: [network.FIXED, names_of(Architecture), seen],
        bits_network.FORMAT: [sorted(BitsNetwork(8).state_dict())],
        policy_file.FORMAT: seen,
        tuning.FORMAT: tuning.STUDY,
        archive.FORMAT: KEYS,
    }
    digests = {
        name: hashlib.sha256(repr(layout).encode()).hexdigest()[:8]
        for name, layout in layouts.items()
    }
    assert digests == DIGESTS
