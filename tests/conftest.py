"""Scenes and checkpoints, good and bad, that the tests of the scripts share."""
# ruff: noqa: E402

import gc
import os

gc.disable()  # until all is imported: see pytest_collection_finish
os.environ.setdefault(
    "OMP_NUM_THREADS", "1"
)  # before torch is imported: each of xdist's processes has one core

import atexit
import pickle
import shutil
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from e2rl.prior.checkpoint import save_prior
from e2rl.prior.denoiser import DenoiserSettings
from e2rl.prior.prior import Prior
from e2rl.run.fused import switched_off
from e2rl.run.weights import HASH
from tests.scenes.descriptions import (
    Malicious,
    description,
    numbered,
    straight,
    write_folder,
)

if (
    "E2RL_TESTS" not in os.environ
):  # the folder of caches of these tests and all processes that they start
    os.environ["E2RL_TESTS"] = tempfile.mkdtemp(prefix="e2rl-tests-")
    atexit.register(shutil.rmtree, os.environ["E2RL_TESTS"], ignore_errors=True)
os.environ.setdefault(
    "MPLCONFIGDIR", matplotlib.get_cachedir()
)  # its list of fonts takes long to make
os.environ["XDG_CACHE_HOME"] = os.environ["E2RL_TESTS"]


def pytest_collection_finish():
    """Modules stay to the end: searching them for garbage, during their import and
    again and again after it, takes a fifth of all time."""
    gc.freeze()
    gc.set_threshold(20_000)
    gc.enable()


@pytest.fixture(autouse=True)
def nothing_compiled():
    """Each test begins eagerly, whatever the one before has switched on."""
    with switched_off():
        yield


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Folders of good and bad scenes, checkpoints of several kinds."""
    root = tmp_path_factory.mktemp("input")
    good = numbered(
        [
            description(
                {"ego": straight(20 + k, 0, speed=8), "7": straight(50, 3.5, speed=6)}
            )
            for k in range(2)
        ]
    )
    nan = description()
    nan["tracks"]["7"]["state"]["position"][40] = np.nan
    bad = {
        "forbidden": pickle.dumps({"x": Malicious(os.system, f"touch {root / 'ran'}")}),
        "nan": nan,
        "damaged": b"nonsense",
    }
    write_folder(root / "good", good)
    for name, scene in bad.items():
        write_folder(root / name, [good[0], scene])
    (root / "empty").mkdir()
    torch.manual_seed(0)
    path = save_prior(
        Prior(DenoiserSettings(width=16, heads=2, blocks=1, pair=8)),
        root,
        origin={"data": "made"},
    )
    path.rename(root / "prior.safetensors")
    _variants(root)
    return root


def _variants(root: Path) -> None:
    """Checkpoints that are none: of another architecture, another format, cut off."""
    with safe_open(root / "prior.safetensors", "pt") as file:
        metadata = file.metadata()
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    del metadata[HASH]  # as a stranger would
    save_file(dict(list(tensors.items())[1:]), root / "other.safetensors", metadata)
    save_file(
        tensors, root / "format.safetensors", metadata | {"format": "e2rl-prior/9"}
    )
    content = (root / "prior.safetensors").read_bytes()
    (root / "cut.safetensors").write_bytes(content[: len(content) // 2])
