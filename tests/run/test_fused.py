"""A fused function gives what it gives eagerly, for every size; what it was not
declared for runs eagerly."""

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from e2rl.run import fused as module
from e2rl.run.errors import InputError
from e2rl.run.fused import FUSED, Fused, fused, has_compiler, switched_off


class Line(NamedTuple):
    """Distance and direction of lines, each [B]."""

    offset: Tensor
    angle: Tensor


calls = []


@fused("B K 2", "B", "3!", "B:bool")
def across(points: Tensor, line: Line, weight: Tensor, counts: Tensor) -> Line:
    """Largest distance [B] of points from lines, where they count, and the lines'
    angles."""
    calls.append(points.shape[0])
    normal = torch.stack([-line.angle.sin(), line.angle.cos()], -1)
    distance = (points * normal[:, None]).sum(-1) - line.offset[:, None]
    return Line(torch.where(counts, distance.amax(-1) * weight.sum(), 0.0), line.angle)


def given(batch: int, count: int) -> tuple:
    draw = torch.Generator().manual_seed(batch)
    points, angle = (
        torch.randn((batch, *shape), generator=draw) for shape in ((count, 2), ())
    )
    return points, Line(angle / 3, angle), torch.arange(3.0), angle > 0


@pytest.fixture
def on():
    with switched_off():
        module.switch(True)
        yield


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler")
@pytest.mark.parametrize(("batch", "count"), [(1, 1), (1, 40), (5, 1), (19, 33)])
def test_compiled_it_gives_what_it_gives_eagerly_for_every_size(on, batch, count):
    points, line, weight, counts = given(batch, count)
    across(points, line, weight, counts)  # compiles it, which calls the function
    calls.clear()
    result = across(points, line, weight, counts)
    assert not calls, "the function itself was called"
    eager = across.function(points, line, weight, counts)
    for first, other in zip(result, eager, strict=True):
        assert torch.allclose(first, other, atol=1e-6)
    assert isinstance(result, Line)
    assert across.file.exists()
    view = points.transpose(0, 1).contiguous().transpose(0, 1)
    assert torch.equal(across(view, line, weight, counts).offset, result.offset), (
        "it depends on how a tensor lies in memory"
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda p, line, w, c: (
            p.double(),
            Line(*(x.double() for x in line)),
            w.double(),
            c,
        ),
        lambda p, line, w, c: (p[:0], Line(*(x[:0] for x in line)), w, c[:0]),
        lambda p, line, w, c: (p.requires_grad_(), line, w, c),
        lambda p, line, w, c: (p, line, w[:2], c),
    ],
    ids=["doubles", "no rows", "gradients", "another size"],
)
def test_what_is_not_as_declared_runs_as_it_is(on, change):
    points, line, weight, counts = change(*given(4, 3))
    calls.clear()
    result = across(points, line, weight, counts)
    assert calls == [len(points)]
    eager = across.function(points, line, weight, counts)
    assert all(
        torch.equal(first, other) for first, other in zip(result, eager, strict=True)
    )


def test_fused_functions_run_as_they_are_until_they_are_switched_on():
    calls.clear()
    across(*given(4, 3))
    assert calls == [4]


def test_its_file_depends_on_its_shapes_and_sources():
    other = Fused(across.function, ("B K 2", "B", "3", "B:bool"))
    FUSED[across.name] = across
    assert across.file.name.startswith("across-")
    assert other.file != across.file
    assert across.file.parent.name == "fused"


def test_without_a_compiler_compiling_is_refused(monkeypatch):
    monkeypatch.setattr(module.shutil, "which", lambda name: None)
    with pytest.raises(InputError, match="compile=true: no C"):
        Fused(across.function, ("B K 2", "B", "3", "B:bool")).compile()
    FUSED[across.name] = across


def one_sided(points: Tensor) -> Tensor:
    """Points [B], if their sum is positive: what no compiler can trace."""
    return points if points.sum().item() > 0 else -points


@pytest.mark.skipif(not has_compiler(), reason="needs a C++ compiler")
def test_what_cannot_be_compiled_is_named_in_one_line():
    function = Fused(one_sided, ("B",))
    try:
        with pytest.raises(
            InputError,
            match=r"^compile=true: torch .* cannot compile .*one_sided \(.*\); take .*$",
        ):
            function.compile()
    finally:
        del FUSED[function.name]
