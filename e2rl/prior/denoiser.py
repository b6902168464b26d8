"""The joint denoiser: vehicles attend to each other with pair features as attention
biases and values."""

import math
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, cast

import torch
from torch import Tensor, nn

from e2rl.prior.features import EDGE, NODE
from e2rl.prior.lane_relative import SIZE
from e2rl.prior.sde import NoiseSchedule
from e2rl.run.config import configured, setting
from e2rl.run.cpu import onednn_products
from e2rl.run.errors import InputError
from e2rl.run.fused import Fused, is_on

MANY = 256  # vehicles of a batch, absent ones included


@configured("prior/default", "network")
@dataclass(frozen=True)
class DenoiserSettings:
    """Sizes of the network (conf/prior/default.yaml); the width is a multiple of the
    heads."""

    width: int = setting(low=1)
    heads: int = setting(low=1)
    blocks: int = setting(low=1)
    pair: int = setting(low=1)
    dropout: float = setting(
        low=0,
        high=1,
    )

    def __post_init__(self) -> None:
        if self.heads and self.width % self.heads:
            raise InputError(
                f"prior.network.width={self.width}: expected a multiple of "
                f"heads={self.heads}"
            )


@dataclass
class Encoding:
    """What the network computes of a scene once per replan, for all denoising steps.

    nodes [B, V, W]; pairs [B, V, V, E]; of each block: the attention biases [B, heads,
    V, V] (-1e4 at absent vehicles) and the nodes' part of the modulation [B, V, 6 W].
    """

    nodes: Tensor
    pairs: Tensor
    biases: list[Tensor]
    modulations: list[Tensor]

    def map(self, function: Callable[[Tensor], Tensor]) -> "Encoding":
        """An Encoding with `function` applied to every tensor."""
        return Encoding(
            function(self.nodes),
            function(self.pairs),
            biases=[function(value) for value in self.biases],
            modulations=[function(value) for value in self.modulations],
        )

    def repeat(self, count: int) -> "Encoding":
        """The same scenes `count` times along the batch."""
        return self.map(lambda value: value.repeat(count, *[1] * (value.ndim - 1)))


class Block(nn.Module):
    """Attention over vehicles and an MLP, modulated by noise level and node
    (adaLN-Zero, Peebles and Xie 2023)."""

    def __init__(
        self,
        width: int,
        heads: int,
        pair: int,
        dropout: float,
    ):
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(width, elementwise_affine=False)
        self.norm_mlp = nn.LayerNorm(width, elementwise_affine=False)
        self.modulation = nn.Linear(width, 6 * width)
        self.qkv = nn.Linear(width, 3 * width)
        self.pair_value = nn.Linear(heads * pair, width)
        self.out = nn.Linear(width, width)
        hidden = 3 * width
        self.mlp = nn.Sequential(
            nn.Linear(width, hidden),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(hidden, width),
        )
        self.drop = nn.Dropout(dropout)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def forward(
        self,
        h: Tensor,
        modulation: Tensor,
        bias: Tensor,
        pairs: Tensor,
    ) -> Tensor:
        """h [B, V, W] after the block.

        Args:
            h: [B, V, W].
            modulation: [B, V, 6 W].
            bias: [B, heads, V, V], of the attention.
            pairs: [B, V, V, E].
        """
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = modulation.chunk(6, -1)
        batch, vehicles, width = h.shape
        size = width // self.heads

        def by_vehicle(value: Tensor) -> Tensor:
            """[B, V, heads, ...] of a value [B heads, V, ...]."""
            return value.unflatten(0, (batch, self.heads)).transpose(1, 2)

        qkv = self.qkv(torch.addcmul(shift_a, self.norm_attention(h), scale_a))
        qkv = qkv.reshape(batch, vehicles, 3, self.heads, size)
        q, k, v = qkv.permute(2, 0, 3, 1, 4).flatten(1, 2)
        scale = 1 / math.sqrt(size)
        logits = torch.baddbmm(bias.flatten(0, 1), q, k.transpose(1, 2), alpha=scale)
        weight = self.drop(torch.softmax(logits, -1))
        mixed = by_vehicle(weight @ v).flatten(2)
        pair = (by_vehicle(weight) @ pairs).flatten(2)
        h = torch.addcmul(h, gate_a, self.out(mixed + self.pair_value(pair)))
        hidden = torch.addcmul(shift_m, self.norm_mlp(h), scale_m)
        return torch.addcmul(h, gate_m, self.mlp(hidden))


class Denoiser(nn.Module):
    """x0 = alpha x + sigma F(x, t | scene), jointly over vehicles. The noise level t
    may differ between them."""

    node_mean: Tensor
    node_std: Tensor
    unit_scale: Tensor
    frequencies: Tensor

    def __init__(self, settings: DenoiserSettings | None = None):
        super().__init__()
        self.settings = settings = settings or DenoiserSettings()
        width = settings.width
        self.schedule = NoiseSchedule()
        self.register_buffer("node_mean", torch.zeros(NODE))
        self.register_buffer("node_std", torch.ones(NODE))
        dropout = nn.Dropout(settings.dropout)
        self.encode_node = nn.Sequential(
            nn.Linear(NODE, 2 * width),
            nn.GELU(),
            dropout,
            nn.Linear(2 * width, width),
        )
        self.encode_pair = nn.Sequential(
            nn.Linear(EDGE, 48),
            nn.GELU(),
            nn.Linear(48, settings.pair),
            nn.GELU(),
        )
        self.bias = nn.Linear(settings.pair, settings.heads * settings.blocks)
        self.embed_x = nn.Linear(SIZE, width)
        self.embed_level = nn.Sequential(
            nn.Linear(32, width),
            nn.GELU(),
            nn.Linear(width, width),
        )
        scales = torch.tensor([0.0, 1.0, 0.0, 0.0, 1.0, 0.0]).repeat_interleave(width)
        self.register_buffer("unit_scale", scales, persistent=False)
        self.register_buffer(
            "frequencies",
            torch.logspace(-0.3, 1.7, 16),
            persistent=False,
        )
        blocks = [
            Block(width, settings.heads, settings.pair, settings.dropout)
            for _ in range(settings.blocks)
        ]
        self.blocks = cast(Iterable[Block], nn.ModuleList(blocks))
        last = nn.Linear(width, SIZE)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.head = nn.Sequential(nn.LayerNorm(width), last)

    def encode(
        self,
        nodes: Tensor,
        pairs: Tensor,
        present: Tensor,
    ) -> Encoding:
        """Encoding of node features [B, V, NODE], pair features [B, V, V, EDGE] and
        presence [B, V]."""
        if self._learns() or not is_on():
            return self.encoding(nodes, pairs, present=present)
        with _products_of(nodes):
            node, pair, *rest = fused_encoding(self.settings)(
                nodes,
                pairs,
                present,
                *self._read,
            )
        return Encoding(
            node,
            pair,
            biases=rest[: self.settings.blocks],
            modulations=rest[self.settings.blocks :],
        )

    def encoding(
        self,
        nodes: Tensor,
        pairs: Tensor,
        present: Tensor,
    ) -> Encoding:
        """`encode`, operation by operation."""
        node = self.encode_node(((nodes - self.node_mean) / self.node_std).clamp(-6, 6))
        pair = self.encode_pair(pairs)
        absent = torch.where(present, 0.0, -1e4).to(pair.dtype)[:, None, None, :]
        bias = self.bias(pair).permute(0, 3, 1, 2) + absent
        # The modulation is linear in node and level: the nodes' part is the same for
        # all levels.
        modulations = [node @ block.modulation.weight.T for block in self.blocks]
        return Encoding(
            node,
            pair,
            biases=[part.contiguous() for part in bias.chunk(self.settings.blocks, 1)],
            modulations=modulations,
        )

    def modulated(self, level: Tensor) -> list[Tensor]:
        """The level's part of each block's modulation [..., V, 6 W], of level [..., V];
        scales are around 1."""
        angle = level[..., None] * self.frequencies
        level = self.embed_level(torch.cat([torch.sin(angle), torch.cos(angle)], -1))
        return [block.modulation(level) + self.unit_scale for block in self.blocks]

    def forward(
        self,
        x: Tensor,
        level: Tensor,
        encoding: Encoding,
    ) -> Tensor:
        """Denoised estimate x0 [B, V, SIZE] of x [B, V, SIZE] at noise level [B, V], or
        [1, V] for all scenes."""
        if (
            self._learns()
            or len(level) > 1
            or not is_on()
            or (torch.is_grad_enabled() and x.requires_grad)
        ):
            return self.estimate(x, level, encoding=encoding)
        with _products_of(x):
            return fused_estimate(self.settings)(
                x,
                level,
                encoding.nodes,
                encoding.pairs,
                *encoding.biases,
                *encoding.modulations,
                *self._read,
            )

    def _learns(self) -> bool:
        """Whether dropout acts, or gradients by the weights are wanted: fused functions
        have neither."""
        return self.training or (
            torch.is_grad_enabled() and self.embed_x.weight.requires_grad
        )

    @cached_property
    def _read(self) -> list[Tensor]:
        """The weights and constants that `estimate` reads."""
        return [*self.parameters(), *self.buffers()]

    def estimate(
        self,
        x: Tensor,
        level: Tensor,
        encoding: Encoding,
    ) -> Tensor:
        """`forward`, operation by operation."""
        h = self.embed_x(x) + encoding.nodes
        of_level = self.modulated(level)
        for index, block in enumerate(self.blocks):
            modulation = encoding.modulations[index] + of_level[index]
            h = block(h, modulation, encoding.biases[index], encoding.pairs)
        alpha = self.schedule.alpha(level)[..., None]
        sigma = self.schedule.sigma(level)[..., None]
        return alpha * x + sigma * self.head(h).to(x.dtype)


def _products_of(values: Tensor) -> AbstractContextManager[None]:
    """The library of the products of a batch [B, V, ...]: oneDNN where it is large, as
    a replan's steps soon earn the time of new sizes."""
    return onednn_products() if values.shape[:2].numel() >= MANY else nullcontext()


class _Module(nn.Module):
    """A method of a Denoiser as a module of its own, for `functional_call`."""

    def __init__(self, settings: DenoiserSettings, method: str) -> None:
        super().__init__()
        self.network = Denoiser(settings).eval()
        self.method = method
        self.names = [
            name for name, _ in (*self.named_parameters(), *self.named_buffers())
        ]
        self.sizes = [" ".join(map(str, value.shape)) for value in self.network._read]

    def forward(self, *values: Any) -> Any:
        return getattr(self.network, self.method)(*values)

    def call(self, weights: Iterable[Tensor], *values: Any) -> Any:
        """The method with these weights and constants."""
        named = dict(zip(self.names, weights, strict=True))
        return torch.func.functional_call(self, named, values)


@cache
def fused_estimate(settings: DenoiserSettings) -> Fused:
    """`Denoiser.estimate` of networks of these sizes: of x, level, nodes, pairs,
    biases, modulations and weights."""
    module = _Module(settings, "estimate")
    blocks = settings.blocks

    def denoise(
        x: Tensor,
        level: Tensor,
        nodes: Tensor,
        pairs: Tensor,
        *rest: Tensor,
    ) -> Tensor:
        encoding = Encoding(
            nodes,
            pairs,
            biases=list(rest[:blocks]),
            modulations=list(rest[blocks : 2 * blocks]),
        )
        return module.call(rest[2 * blocks :], x, level, encoding)

    shapes = (
        f"B V {SIZE}",
        "1 V",
        f"B V {settings.width}",
        f"B V V {settings.pair}",
        *[f"B {settings.heads} V V"] * blocks,
        *[f"B V {6 * settings.width}"] * blocks,
        *module.sizes,
    )
    return Fused(denoise, shapes, constants=len(module.sizes))


@cache
def fused_encoding(settings: DenoiserSettings) -> Fused:
    """`Denoiser.encoding` of networks of these sizes: nodes, pairs, biases and
    modulations."""
    module = _Module(settings, "encoding")

    def encode(
        nodes: Tensor, pairs: Tensor, present: Tensor, *weights: Tensor
    ) -> tuple[Tensor, ...]:
        scene = module.call(weights, nodes, pairs, present)
        return scene.nodes, scene.pairs, *scene.biases, *scene.modulations

    shapes = (f"B V {NODE}", f"B V V {EDGE}", "B V:bool", *module.sizes)
    return Fused(encode, shapes, constants=len(module.sizes))
