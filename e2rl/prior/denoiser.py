"""The joint denoiser: vehicles attend to each other with pair features as attention biases and values."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from e2rl.prior.features import EDGE, NODE
from e2rl.prior.lane_relative import SIZE
from e2rl.prior.sde import NoiseSchedule


@dataclass(frozen=True)
class DenoiserSettings:
    """Width, attention heads, blocks, width of the pair embedding, share of activations dropped in training."""

    width: int = 96
    heads: int = 4
    blocks: int = 3
    pair: int = 24
    dropout: float = 0.1


@dataclass
class Encoding:
    """What the network keeps of a scene over the denoising steps of one replan: nodes [B, V, W], pair values
    [B, V, V, E], attention biases per block [B, heads, V, V] (absent vehicles at -inf)."""

    nodes: Tensor
    pairs: Tensor
    biases: list[Tensor]

    def repeat(self, count: int) -> "Encoding":
        """The same scenes `count` times along the batch."""
        tile = lambda value: value.repeat(count, *[1] * (value.ndim - 1))  # noqa: E731
        return Encoding(tile(self.nodes), tile(self.pairs), [tile(bias) for bias in self.biases])


class Block(nn.Module):
    """Attention over vehicles and an MLP, both modulated by noise level and node (adaLN-zero)."""

    def __init__(self, width: int, heads: int, pair: int, dropout: float):
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(width, elementwise_affine=False)
        self.norm_mlp = nn.LayerNorm(width, elementwise_affine=False)
        self.modulation = nn.Linear(width, 6 * width)
        self.qkv = nn.Linear(width, 3 * width)
        self.pair_value = nn.Linear(heads * pair, width)
        self.out = nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, 3 * width), nn.GELU(), nn.Dropout(dropout),
                                 nn.Linear(3 * width, width))
        self.drop = nn.Dropout(dropout)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def forward(self, h: Tensor, condition: Tensor, bias: Tensor, pairs: Tensor) -> Tensor:
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = self.modulation(condition).chunk(6, -1)
        batch, vehicles, width = h.shape
        q, k, v = self.qkv(self.norm_attention(h) * (1 + scale_a) + shift_a).reshape(
            batch, vehicles, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        weight = self.drop(torch.softmax(q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1]) + bias, -1))
        mixed = (weight @ v).transpose(1, 2).reshape(batch, vehicles, width)
        pair = torch.einsum("bhij,bije->bihe", weight, pairs).flatten(2)
        h = h + gate_a * self.out(mixed + self.pair_value(pair))
        return h + gate_m * self.mlp(self.norm_mlp(h) * (1 + scale_m) + shift_m)


class Denoiser(nn.Module):
    """x0 = alpha x + sigma F(x, t | scene), jointly over vehicles; t may differ between them (the ego's is clean)."""

    def __init__(self, settings: DenoiserSettings = DenoiserSettings()):  # noqa: B008 - frozen
        super().__init__()
        self.settings, width = settings, settings.width
        self.schedule = NoiseSchedule()
        self.register_buffer("node_mean", torch.zeros(NODE))
        self.register_buffer("node_std", torch.ones(NODE))
        self.encode_node = nn.Sequential(nn.Linear(NODE, 2 * width), nn.GELU(), nn.Dropout(settings.dropout),
                                         nn.Linear(2 * width, width))
        self.encode_pair = nn.Sequential(nn.Linear(EDGE, 48), nn.GELU(), nn.Linear(48, settings.pair), nn.GELU())
        self.bias = nn.Linear(settings.pair, settings.heads * settings.blocks)
        self.embed_x = nn.Linear(SIZE, width)
        self.embed_level = nn.Sequential(nn.Linear(32, width), nn.GELU(), nn.Linear(width, width))
        self.blocks = nn.ModuleList(
            Block(width, settings.heads, settings.pair, settings.dropout) for _ in range(settings.blocks))
        self.head = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, SIZE))
        nn.init.zeros_(self.head[1].weight)
        nn.init.zeros_(self.head[1].bias)

    def encode(self, nodes: Tensor, pairs: Tensor, present: Tensor) -> Encoding:
        """Encoding of node features [B, V, NODE], pair features [B, V, V, EDGE] and presence [B, V]."""
        node = self.encode_node(((nodes - self.node_mean) / self.node_std).clamp(-6, 6))
        pair = self.encode_pair(pairs)
        absent = torch.zeros_like(present, dtype=pair.dtype).masked_fill(~present, -1e4)[:, None, None, :]
        bias = self.bias(pair).permute(0, 3, 1, 2) + absent
        return Encoding(node, pair, list(bias.chunk(self.settings.blocks, 1)))

    def forward(self, x: Tensor, level: Tensor, encoding: Encoding) -> Tensor:
        """Denoised estimate x0 [B, V, SIZE] of x [B, V, SIZE] at noise level [B, V]."""
        angle = level[..., None] * torch.logspace(-0.3, 1.7, 16, device=x.device)
        h = self.embed_x(x) + encoding.nodes
        condition = encoding.nodes + self.embed_level(torch.cat([torch.sin(angle), torch.cos(angle)], -1))
        for block, bias in zip(self.blocks, encoding.biases, strict=True):
            h = block(h, condition, bias, encoding.pairs)
        alpha, sigma = self.schedule.alpha(level)[..., None], self.schedule.sigma(level)[..., None]
        return alpha * x + sigma * self.head(h).to(x.dtype)
