"""Several processes train one prior: equal weights everywhere, the whole batch's
update, exact resume, and the command.

Two processes over gloo run `_work` once; the tests look at what they left behind.
"""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch.multiprocessing import spawn

from e2rl.learning.pretraining.prior.distributed import ALONE, Processes, process_group
from e2rl.learning.pretraining.prior.loss import draw
from e2rl.learning.pretraining.prior.training import PriorTraining, TrainingSettings
from e2rl.learning.pretraining.prior.windows import make_windows
from e2rl.prior.checkpoint import load_prior
from e2rl.run.errors import InputError
from tests.prior.small import curved_scenes, small_prior

ROOT = Path(__file__).parents[4]
SETTINGS = TrainingSettings(steps=6, batch=4, bf16=False)


def training(windows, processes, seed=0):
    return PriorTraining(
        small_prior(seed).requires_grad_(True),
        windows,
        test=windows,
        settings=SETTINGS,
        processes=processes,
    )


def prearranged(windows, part=slice(None)):
    """Whole batches with their random numbers, or a part of each."""
    batches = [windows[k : k + 4] for k in (0, 3, 1)]
    drawn = [
        draw(batch, torch.Generator().manual_seed(k)) for k, batch in enumerate(batches)
    ]
    return [
        (batch[part], numbers[part])
        for batch, numbers in zip(batches, drawn, strict=True)
    ]


def updates(run, windows, part=slice(None)):
    """The gradients after the first of three prearranged updates, and the weights after
    the last."""
    gradients = None
    for batch, numbers in prearranged(windows, part):
        run.update(batch, numbers)
        gradients = gradients or {
            key: value.grad.clone()
            for key, value in run.prior.denoiser.named_parameters()
        }
    return gradients, dict(run.prior.denoiser.state_dict())


def _work(rank, folder, port):
    torch.set_num_threads(1)
    os.environ |= {
        "RANK": str(rank),
        "LOCAL_RANK": str(rank),
        "WORLD_SIZE": "2",
        "LOCAL_WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "TORCHELASTIC_RUN_ID": "test",
    }
    windows = torch.load(folder / "windows.pt", weights_only=False)
    with process_group("cpu") as (processes, device):
        assert (processes.rank, processes.count, device) == (rank, 2, "cpu")
        whole = training(
            windows, processes, seed=rank
        )  # other first weights: the leader's count
        half = whole.train(3), whole.state_dict()
        torch.save(half[1], folder / f"half{rank}.pt")
        whole.train(6)
        again = training(windows, processes)
        again.load_state_dict(torch.load(folder / f"half{rank}.pt", weights_only=True))
        again.train(6)
        shared = updates(
            training(windows, processes), windows, part=slice(2 * rank, 2 * rank + 2)
        )
        assert processes.mean(torch.tensor([float(rank)])) == 0.5
    torch.save(
        {
            "average": whole.average.state_dict(),
            "weights": dict(whole.prior.denoiser.state_dict()),
            "generator": whole.generator.get_state(),
            "resumed": again.average.state_dict(),
            "shared": shared,
        },
        folder / f"rank{rank}.pt",
    )


@pytest.fixture(scope="module")
def windows():
    windows = make_windows(curved_scenes(2))
    windows["weight"][:2, 1:4] = 0
    return windows


@pytest.fixture(scope="module")
def ranks(windows, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranks")
    torch.save(windows, folder / "windows.pt")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    spawn(_work, (folder, port), nprocs=2)
    return [
        torch.load(folder / f"rank{rank}.pt", weights_only=False) for rank in (0, 1)
    ]


def same(one, two):
    return all(torch.equal(one[key], two[key]) for key in one)


@pytest.mark.slow
def test_weights_and_averages_are_the_same_everywhere_and_the_noise_is_not(ranks):
    one, two = ranks
    assert same(one["weights"], two["weights"])
    assert same(one["average"], two["average"])
    assert not torch.equal(one["generator"], two["generator"])


@pytest.mark.slow
def test_an_interrupted_run_of_two_goes_on_exactly(ranks):
    for rank in ranks:
        assert same(rank["average"], rank["resumed"])


@pytest.mark.slow
def test_halves_of_a_batch_make_the_update_of_the_whole(ranks, windows):
    """Also where the halves weigh differently."""
    weight = prearranged(windows)[0][0]["weight"]
    assert weight[:2].sum() != weight[2:].sum()
    gradients, weights = updates(training(windows, ALONE), windows)
    for rank in ranks:
        for key, value in gradients.items():
            torch.testing.assert_close(
                rank["shared"][0][key], value, rtol=1e-4, atol=1e-6, msg=key
            )
        for key, value in weights.items():
            torch.testing.assert_close(
                rank["shared"][1][key], value, rtol=1e-3, atol=1e-5, msg=key
            )


def test_a_batch_that_cannot_be_shared_and_another_number_of_processes_are_refused(
    windows,
):
    with pytest.raises(InputError, match="batch=4: 3 processes"):
        PriorTraining(
            small_prior(),
            windows,
            test=windows,
            settings=SETTINGS,
            processes=Processes(0, 3),
        )
    run = training(windows, ALONE)
    state = run.state_dict()
    with pytest.raises(InputError, match="begun by 2 processes"):
        run.load_state_dict(state | {"draws": state["draws"] * 2})


@pytest.mark.slow
@pytest.mark.skipif(
    torch.cuda.is_available(), reason="one process a GPU: tests the CPU's way"
)
def test_torchrun_trains_with_the_real_command(tmp_path):
    data = ["field_cells=64", "vehicles=4", "others=2", "steps=20"]
    stage = ["steps=2", "validate_every=1", "route_steps=5", "batch=4", "starts=[10]"]
    small = [
        "num_scenes=4",
        "data.workers=1",
        "prior.sampler.steps=2",
        *(f"data.build.{each}" for each in data),
    ]
    small += [*(f"stage.{each}" for each in stage), f"data.cache={tmp_path / 'cache'}"]
    small += [
        *(f"prior.network.{each}" for each in ("width=16", "heads=2", "blocks=1"))
    ]
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc_per_node=2",
        ROOT / "train.py",
    ]
    command += ["stage=prior", f"hydra.run.dir={tmp_path / 'run'}", *small]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("checkpoint: ") == 1
    assert (tmp_path / "run" / "metrics.json").exists()
    (checkpoint,) = (tmp_path / "run").glob("prior-*.safetensors")
    assert load_prior(str(checkpoint))[1]["processes"] == 2
    losses = (
        (tmp_path / "run/logs/scalars/train/prior_held_out_loss.csv")
        .read_text()
        .split()
    )
    assert len(losses) == 2, "the leader alone writes"
