"""The scripts run in this process, which spares seconds of imports each: their
overrides, status and messages."""

import runpy
import sys
from pathlib import Path

import torch
from hydra.core.global_hydra import GlobalHydra

ROOT = Path(__file__).parents[1]
SMALL = [
    "data.build.field_cells=64",
    "data.build.vehicles=4",
    "data.build.others=2",
    "data.workers=1",
]
SHORT = [
    "data.split=tune",
    "num_scenes=2",
    "data.workers=1",
    "data.build.steps=20",
    "data.build.vehicles=8",
    "data.build.others=2",
    "data.build.field_cells=128",
    "prior.sampler.steps=2",
]  # of the bundled scenes


def arguments(world: Path, folder: Path, data: str, *more: str) -> list[str]:
    """Overrides for scenes `data` with everything that is written below `folder`."""
    return [
        "data=scenarionet",
        f"data.path={world / data}",
        f"data.cache={folder / 'cache'}",
        *SMALL,
        f"prior.checkpoint={world / 'prior.safetensors'}",
        f"hydra.run.dir={folder / 'run'}",
        *more,
    ]


def left_behind(folder: Path) -> list[str]:
    """Files below a folder other than Hydra's record of the configuration and the log."""
    return [
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.is_file() and ".hydra" not in path.parts and path.suffix != ".log"
    ]


def call(script: str, overrides: list[str], monkeypatch, capsys) -> tuple[int, str]:
    """Exit status and what stderr says of a script run in this process, progress bars
    apart."""
    monkeypatch.setattr(sys, "argv", [str(ROOT / script), *overrides])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    threads = torch.get_num_threads()
    try:
        runpy.run_path(str(ROOT / script), run_name="__main__")
        status = 0
    except SystemExit as stop:
        status = stop.code
    finally:
        GlobalHydra.instance().clear()
        torch.set_num_threads(threads)
    said = capsys.readouterr()
    assert "Traceback" not in said.err + said.out
    return status, said.err


def error_line(said: str) -> str:
    """The one line that begins with error:."""
    lines = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, said
    return lines[0]
