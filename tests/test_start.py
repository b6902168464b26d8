"""A command loads the libraries that it uses, and no others: most of the time until it
begins is theirs."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TENSORS = {"torch", "tensordict", "torchrl", "scipy", "networkx", "safetensors"}
PICTURES = {"matplotlib", "PIL"}
ALL_OF_SCIPY = {"scipy.stats", "scipy.signal", "scipy.interpolate"}
DRIVING = {"torchrl", "ray", "jsonschema"}  # TorchRL loads ray where it is installed
DASHBOARDS = {"wandb", "tensorboard", "optuna", "pandas"}
CONFIGURATION = {"numpy", "hydra", "omegaconf", "yaml"}
LIBRARIES = TENSORS | PICTURES | ALL_OF_SCIPY | DRIVING | DASHBOARDS | CONFIGURATION

STEPS = """
import contextlib, json, os, runpy, sys
libraries, *statements = map(json.loads, sys.argv[1:])
for statement in statements:
    sys.argv = statement["argv"]
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(None):
        exec(statement["code"])
    print(json.dumps([name for name in libraries if name in sys.modules]))
"""


def loaded_after(*steps: tuple[str, list[str]]) -> list[set[str]]:
    """The LIBRARIES that a fresh process has loaded after each statement, with the
    command line of each."""
    arguments = [json.dumps(sorted(LIBRARIES))]
    arguments += [json.dumps({"code": code, "argv": argv}) for code, argv in steps]
    process = subprocess.run(
        [sys.executable, "-c", STEPS, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return [set(json.loads(line)) for line in process.stdout.splitlines()]


def imported(*commands: str) -> tuple[str, list[str]]:
    """The import of commands, as a step."""
    return "import " + ", ".join(f"e2rl.commands.{name}" for name in commands), []


CLI = "from e2rl.commands.cli import main; main()"


def test_the_package_and_the_list_of_commands_load_nothing():
    package, commands = loaded_after(
        ("import e2rl", []),
        (CLI, ["e2rl", "--help"]),
    )
    assert package == set()
    assert commands == set()


SCRIPT = "runpy.run_path('evaluate.py', run_name='__main__')"


@pytest.mark.parametrize(
    ("code", "arguments"),
    [
        (CLI, ["e2rl", "evaluate", "--help"]),
        (CLI, ["e2rl", "train", "--help"]),
        (CLI, ["e2rl", "tune", "--help"]),
        (CLI, ["e2rl", "rate", "--help"]),
        (CLI, ["e2rl", "cross", "--help"]),
        (CLI, ["e2rl", "check", "--help"]),
        (SCRIPT, ["evaluate.py", "--help"]),
        (SCRIPT, ["evaluate.py", "ergo=idm"]),
        (imported("merge")[0], []),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_options_are_read_without_tensors(code, arguments):
    """Also a wrong one, and the shards of a run are joined without any."""
    (loaded,) = loaded_after((code, arguments))
    assert loaded <= CONFIGURATION


def test_the_number_of_scenes_is_computed_without_tensors():
    (loaded,) = loaded_after(imported("power"))
    assert not loaded & (TENSORS - {"scipy"} | PICTURES | CONFIGURATION - {"numpy"})


def test_commands_load_what_they_use():
    """Tables and logs are read without a simulator or pictures, pictures drawn without
    a simulator, and rollouts driven without pictures."""
    tables, pictures = loaded_after(
        imported("gate", "compare", "report", "export", "try_planner"),
        imported("replay", "inspect"),
    )
    assert not tables & (DRIVING | PICTURES | ALL_OF_SCIPY | DASHBOARDS)
    assert not pictures & (DRIVING | DASHBOARDS)
    (driving,) = loaded_after(
        ("import e2rl.evaluation.plan, e2rl.report.results, e2rl.commands.rate", [])
    )
    assert not driving & (PICTURES | ALL_OF_SCIPY | DASHBOARDS)
