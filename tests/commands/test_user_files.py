"""No file of a user is changed by the commands of README.md: they write into their
run's folder and the cache alone."""

import os
import re
import shlex
import subprocess
import sys
from itertools import count
from pathlib import Path

import pytest

from tests.scripts import ROOT, SHORT
from tests.test_scripts import ROUND

pytestmark = pytest.mark.slow
MINE = [
    "study.json",
    "scene.png",
    "tables.md",
    "metrics.json",
    "failures.html",
    "runs.txt",
    ".cache/notes",
]
HOME = [
    ".bashrc",
    ".profile",
    "study.json",
    "thesis/a.tex",
    ".cache/e2rl/scenes-thesis.map",
    ".cache/other/scenes-1",
]
SIZE = [
    "data.workers=1",
    "prior.sampler.steps=2",
    "data.cache_gb=0",
    "data.build.steps=20",
    "data.build.field_cells=64",
]
PRIOR = [
    f"stage.{each}"
    for each in (
        "steps=2",
        "batch=2",
        "route_steps=2",
        "validate_every=1",
        "starts=[10]",
    )
]
PRIOR += [
    "prior.network.width=16",
    "prior.network.heads=2",
    "prior.network.blocks=1",
    "prior.network.pair=8",
]
SMALL = {  # what makes a command of README.md quick, by a part of it
    "python evaluate.py": [
        *SIZE,
        "processes=1",
        "num_scenes=2",
        "seeds=[0]",
        "tries=2",
    ],
    "stage=prior": [*SIZE, *PRIOR],
    "python train.py": [
        *SIZE,
        *ROUND,
        "num_scenes=4",
        "measure.scenes=2",
        "measure.budget=40",
    ],
}


def commands(world: Path) -> list[list[str]]:
    """The commands of README.md that neither install nor test, made small; where they
    name a file, one is there."""
    blocks = re.findall(
        r"```bash\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL
    )
    lines = [
        line
        for block in blocks
        for line in block.splitlines()
        if re.search(r"python \w+\.py|^e2rl ", line)
    ]
    result = []
    for line in lines:
        small = next(
            (options for part, options in SMALL.items() if part in line),
            ["--workers", "1"],
        )
        line = re.sub(r"\b(OTHER_)?LOGS\b", str(world / "good"), line)
        line = line.replace("=FILE", f"={world / 'prior.safetensors'}").replace(
            "examples", str(ROOT / "examples")
        )
        words = [
            word
            for word in shlex.split(line)
            if "=examples" not in word and not word.startswith("PYTHONPATH=")
        ]
        if "data=" not in line and words[0] == "python":
            small = [*SHORT[:1], *small]
        program = (
            [str(ROOT / words[1])]
            if words[0] == "python"
            else ["-m", "e2rl.commands.cli", words[1]]
        )
        result.append([sys.executable, *program, *words[2:], *small])
    return result


def contents(*folders: Path) -> dict[Path, bytes]:
    return {
        path: path.read_bytes()
        for folder in folders
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_commands_write_into_their_folder_and_the_cache_alone(world, tmp_path):
    """Every command of the README. Of two at once, the first names a folder and one of
    them is refused; the last does not, and each has its own."""
    home = tmp_path / "home"
    here = tmp_path / "work"
    size = count(1)
    for path in [*(home / name for name in HOME), *(here / name for name in MINE)]:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"mine" * next(size))
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("XDG_CACHE_HOME", "MPLCONFIGDIR")
    }
    environment |= {
        "HOME": str(home),
        "PYTHONPATH": f"{ROOT}:{ROOT / 'examples'}",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    before = contents(home, here, world)
    requests = commands(world)
    assert len(requests) >= 5
    assert "hydra.run.dir=" in str(requests[0])
    assert "hydra.run.dir=" not in str(requests[-1])
    for number, command in enumerate(requests):
        twice = 1 + (number in (0, len(requests) - 1))
        start = [
            subprocess.Popen(
                command, cwd=here, env=environment, stderr=subprocess.PIPE, text=True
            )
            for _ in range(twice)
        ]
        said = [each.communicate(timeout=600)[1] for each in start]
        assert sorted(each.returncode for each in start) == (
            [0, 2] if number == 0 else [0] * twice
        ), (command, said)
    after = contents(home, here, world)
    assert {path: after.get(path) for path in before} == before
    allowed = (here / "runs", home / ".cache" / "e2rl", home / ".cache" / "matplotlib")
    assert not [
        path
        for path in after.keys() - before.keys()
        if not any(map(path.is_relative_to, allowed))
    ]
    runs = [path.parent for path in (here / "runs").rglob("provenance.json")]
    assert len(runs) == sum("inspect" not in command for command in requests) + 1
