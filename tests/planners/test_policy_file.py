"""A policy's file drives by what it returns, and is refused with one message where it
is no policy."""

import os
import random
import time
from contextlib import suppress
from importlib.util import find_spec

import pytest
import torch
from torch import nn

from e2rl.commands.export_policy import export_actor
from e2rl.planners import policy_file
from e2rl.planners.actor import ActorEgo
from e2rl.planners.ego_errors import NotFinite
from e2rl.planners.ego_policy import EgoPolicy
from e2rl.planners.onnx_policy import check_arithmetic
from e2rl.planners.policy_file import MAX_FILE, PolicyFileEgo, within_time
from e2rl.run.errors import InputError
from e2rl.sim.env import DrivingEnv, SimSettings
from e2rl.sim.observation import OBSERVATION_SIZE
from tests.planners.test_actor import wild
from tests.synthetic import make_scenes

needs_onnx = pytest.mark.skipif(
    not (find_spec("onnxruntime") and find_spec("onnxscript")), reason="extra onnx"
)


class Acts(nn.Module):
    """A policy by a function of the observations."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, observation):
        return self.function(observation)


def proportional(observation):
    """Accelerates towards 12 m/s, steers by nothing."""
    return torch.cat([12.0 - 15.0 * observation[:, :1], 0 * observation[:, :1]], 1)


def scripted(folder, function):
    torch.jit.save(
        torch.jit.trace(Acts(function), torch.zeros(2, OBSERVATION_SIZE)),
        folder / "policy.pt",
    )
    return str(folder / "policy.pt")


def test_it_drives_by_its_actions_within_the_bounds(tmp_path):
    env = DrivingEnv(make_scenes(2, speed=6.0), SimSettings(), 2, agents=True)
    ego = PolicyFileEgo(scripted(tmp_path, proportional))
    td = EgoPolicy(ego, env)(env.reset())
    assert torch.equal(td["action"], torch.tensor([[5.0, 0.0]] * 2)), (
        "6 m/s^2 are asked for"
    )
    assert td["ego", "plan"][:, 4, 3].tolist() == pytest.approx([8.5, 8.5])
    assert td["ego", "plan"][:, -1, 3].tolist() == pytest.approx([12, 12], abs=0.1), (
        "the plan is what it would do"
    )
    with pytest.raises(NotFinite):
        EgoPolicy(
            PolicyFileEgo(scripted(tmp_path, lambda seen: proportional(seen) / 0)), env
        )(env.reset())


@pytest.mark.parametrize(("rows", "numbers"), [(None, 3), (1, 2)])
def test_other_shapes_are_refused(tmp_path, rows, numbers):
    with pytest.raises(
        InputError,
        match=rf"fails at observations .*float32 \[1, {numbers}\]; it maps .*for every B",
    ):
        PolicyFileEgo(scripted(tmp_path, lambda seen: seen[:rows, :numbers]))


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("policy.pt", None, "No such file"),
        ("policy.pt", b"nonsense", "no TorchScript archive"),
        ("policy.onnx", b"nonsense", "cannot be read as ONNX"),
        ("policy.csv", b"nonsense", "no kind of policy"),
        ("policy.onnx", os.mkfifo, "no regular file"),
        ("policy.onnx", bytes(MAX_FILE + 1), "larger than"),
    ],
)
def test_what_is_no_policy_is_named(
    tmp_path,
    name,
    content,
    what,
):
    if callable(content):
        content(tmp_path / name)
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=f"ego.file=.*{name}: .*{what}"):
        PolicyFileEgo(str(tmp_path / name))


def onnx_file(file, *nodes, functions=(), **constants):
    """Write a graph in which "two" is what the observation "x" begins with, and "y" the
    action."""
    import numpy as np
    from onnx import helper, numpy_helper

    constants = {"first": [0], "last": [2], "axis": [1]} | constants
    cut = helper.make_node("Slice", ["x", "first", "last", "axis"], ["two"])
    sides = [
        [helper.make_tensor_value_info(name, 1, ["b", size])]
        for name, size in (("x", OBSERVATION_SIZE), ("y", 2))
    ]
    held = [
        numpy_helper.from_array(np.array(value), name)
        for name, value in constants.items()
    ]
    graph = helper.make_graph([cut, *nodes], "policy", *sides, held)
    versions = [helper.make_opsetid("", 18), helper.make_opsetid("own", 1)]
    model = helper.make_model(
        graph,
        opset_imports=versions,
        ir_version=9,
        functions=functions,
    )
    file.write_bytes(model.SerializeToString())
    return str(file)


@needs_onnx
def test_a_graph_of_arithmetic_drives_and_one_that_takes_forever_or_all_memory_is_refused(
    tmp_path,
):
    from onnx import helper

    node = helper.make_node
    file = tmp_path / "policy.onnx"
    ego = PolicyFileEgo(onnx_file(file, node("Neg", ["two"], ["y"])))
    assert torch.equal(
        ego.decide(torch.full((3, OBSERVATION_SIZE), 0.5)), torch.full((3, 2), -0.5)
    )
    body = helper.make_graph([], "body", [], [])
    with pytest.raises(InputError, match="control flow"):
        PolicyFileEgo(
            onnx_file(
                file,
                node("Loop", ["n", "yes", "two"], ["y"], body=body),
                n=10**12,
                yes=True,
            )
        )
    double = helper.make_function(
        "own",
        "f",
        ["a"],
        ["r"],
        [node("Add", ["a", "a"], ["r"])],
        [helper.make_opsetid("", 18)],
    )
    with pytest.raises(InputError, match="functions"):
        PolicyFileEgo(
            onnx_file(file, node("f", ["two"], ["y"], domain="own"), functions=[double])
        )
    for kind, inputs in (("ConstantOfShape", ["s"]), ("Expand", ["yes", "s"])):
        nodes = (
            node(kind, inputs, ["many"]),
            node("Cast", ["many"], ["real"], to=1),
            node("ReduceMax", ["real"], ["most"]),
        )
        with pytest.raises(InputError, match=r"fails at observations|cannot be read"):
            PolicyFileEgo(
                onnx_file(
                    file,
                    *nodes,
                    node("Add", ["two", "most"], ["y"]),
                    s=[3 * 10**9],
                    yes=True,
                )
            )


def test_opening_has_a_limit_of_time(monkeypatch):
    monkeypatch.setattr(policy_file, "SECONDS", 0.05)
    assert within_time(lambda: 7, "it") == 7
    with pytest.raises(ZeroDivisionError):
        within_time(lambda: 1 / 0, "it")
    with pytest.raises(InputError, match="it: .*longer than"):
        within_time(lambda: time.sleep(2), "it")


def test_damaged_bytes_are_refused_or_arithmetic():
    """A graph of nodes with attributes and tensors, cut off or with changed bytes,
    raises nothing else."""

    def field(number, content):
        return bytes([number << 3 | 2, len(content)]) + content

    tensor = b"\x08\x02\x10\x01" + field(9, bytes(8))
    node = field(2, b"y") + field(5, field(1, b"v") + field(5, tensor))
    whole = b"\x08\x09" + field(7, 3 * field(1, node) + field(5, tensor))
    check_arithmetic(memoryview(whole))
    with pytest.raises(ValueError):
        check_arithmetic(memoryview(whole[:-1]))
    with pytest.raises(ValueError, match="parts"):
        check_arithmetic(memoryview(b"\x12\x00" * 200_001))
    draw = random.Random(0)
    for _ in range(2000):
        changed = bytearray(whole)
        for _ in range(draw.randint(1, 4)):
            changed[draw.randrange(len(whole))] = draw.randrange(256)
        with suppress(ValueError):
            check_arithmetic(memoryview(changed))


def drive(ego, **options):
    """States [30, 3, 4] of the egos of three scenes with others around."""
    env = DrivingEnv(
        make_scenes(
            3,
            num_vehicles=6,
            red_light_x=60.0,
        ),
        SimSettings(),
        3,
        agents=True,
        **options,
    )
    env.reset()
    td = env.reset(
        env.reset().select("scene_index").set("scene_index", torch.arange(3)[:, None])
    )
    policy = EgoPolicy(ego, env)
    states = []
    for _ in range(30):
        td = env.step(policy(td))["next"].exclude("reward")
        states.append(env.world().states[:, 0].clone())
    return torch.stack(states)


@pytest.fixture(scope="module")
def actor():
    """With an opinion, and statistics of observations of its own."""
    torch.manual_seed(1)
    ego = wild(
        ActorEgo(
            hidden=(16, 8),
            room=3.0,
        ),
        0.1,
    )
    ego.network.normaliser.observe(torch.randn(50, OBSERVATION_SIZE))
    return ego


@pytest.mark.parametrize(
    "name", ["policy.pt", pytest.param("policy.onnx", marks=needs_onnx)]
)
def test_the_same_rollouts(actor, tmp_path, name):
    actor.network.save(tmp_path / "actor.safetensors")
    export_actor(str(tmp_path), tmp_path / name)
    ego = PolicyFileEgo(str(tmp_path / name))
    observation = 2 * torch.randn(200, OBSERVATION_SIZE)
    expected = actor.act(None, observation, None)
    assert torch.allclose(ego.decide(observation), expected, atol=1e-5)
    assert expected.std(0).min() > 0.05
    driven = drive(ego)
    own = drive(actor)
    assert torch.allclose(driven, own, atol=1e-3)
    assert (own[-1, :, 0] - own[0, :, 0]).min() > 5
