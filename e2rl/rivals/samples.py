"""Several joint samples of the same scenes: S of them along the batch, and back to [S, B, ...]."""

from collections.abc import Callable
from dataclasses import replace

from torch import Tensor

from e2rl.prior.lane_relative import LaneState
from e2rl.prior.prior import Context, Prior
from e2rl.synthesizer.potentials import SAMPLED_STEPS
from e2rl.traffic.rows import map_tensors


def tiled(context: Context, count: int) -> Context:
    """The Context of scenes [B] `count` times along the batch, [count * B]."""
    if count == 1:
        return context

    def tile(value: Tensor) -> Tensor:
        return value.repeat(count, *[1] * (value.ndim - 1))

    return mapped(context, tile)


def of_scenes(context: Context, rows: Tensor) -> Context:
    """The Context of scenes rows [G] of those of a Context."""
    return mapped(context, lambda value: value[rows])


def mapped(context: Context, function: Callable[[Tensor], Tensor]) -> Context:
    """A Context with `function` applied to every tensor."""
    return replace(map_tensors(function, context), encoding=context.encoding.map(function))


def folded(noise: Tensor) -> Tensor:
    """Noise [K, B, V, S, SIZE] of S samples as [K, S * B, V, SIZE], the order of `tiled`."""
    return noise.permute(0, 3, 1, 2, 4).flatten(1, 2)


def motion_of(prior: Prior, x0: Tensor, context: Context, count: int, steps: slice = SAMPLED_STEPS) -> LaneState:
    """Planned motion of x0 [count * B, V, SIZE], fields [count, B, V, T] at `steps` of the plan."""
    return prior.decode(x0, context, steps=steps).map(lambda value: value.unflatten(0, (count, -1)))


def pick(values: Tensor, index: Tensor) -> Tensor:
    """values [S, B, V, ...] at sample index [B] of each scene or [B, V] of each vehicle -> [B, V, ...]."""
    index = index[:, None].expand(values.shape[1:3]) if index.ndim == 1 else index
    index = index.reshape(1, *index.shape, *[1] * (values.ndim - 3)).expand(1, *values.shape[1:])
    return values.gather(0, index)[0]
