"""The Gaussian decoder: features and a target scale -> nine raw numbers per Gaussian (Sec. 3).

Each window of the feature map gets a grid of learned Gaussian embeddings. Condition injection
(window cross-attention) tells them what the picture shows there, Gaussian interaction blocks
(window self-attention) let them talk, pixel shuffling multiplies them, and five heads read off
opacity, colour, standard deviation, offset and correlation. Every layer also adds the scale.

There are two kinds: the paper's, with a position bias in its attention, and the enhanced one of the
supplementary, with rotary positions and a convolution at the end of each block and of all blocks.
Attribute names follow the released checkpoints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn

from ..errors import RequestError
from .attention import (
    MLP,
    Position,
    ScaleAttention,
    WindowAttention,
    from_windows,
    on_grid,
    to_windows,
)
from .state import State, count, side

HEADS = {"sigma": 2, "rho": 1, "alpha": 1, "rgb": 3, "mean": 2}  # name -> columns, in raw order

CACHED = 1024  # tokens whose hidden layers in a head fit in a processor's cache


@dataclass(frozen=True)
class DecoderConfig:
    """The defaults are the paper's (k = 12, m = 16, d = 180, L = 6).

    channels: d, width of a token.
    heads: attention heads; channels is a multiple of it.
    window: k, side of a window in source pixels.
    seeds: Gaussian embeddings along one side of a window (before pixel shuffling).
    cross_blocks, cross_layers: condition injection.
    self_blocks, self_layers: L interaction blocks, layers in each.
    shuffle: up-sampling factors of the two pixel shuffles; m = (seeds/window * product)^2.
    head_expansion: width of the hidden layer of the five heads, in units of channels.
    position: how attention encodes position; "bias": the paper's decoder, "rotary": the enhanced.
    """

    channels: int = 180
    heads: int = 6
    window: int = 12
    seeds: int = 12
    cross_blocks: int = 1
    cross_layers: int = 2
    self_blocks: int = 6
    self_layers: int = 6
    shuffle: tuple[int, int] = (2, 2)
    head_expansion: int = 4
    position: Position = "bias"

    def __post_init__(self) -> None:
        if self.channels % self.heads or (self.enhanced and self.channels // self.heads % 2):
            raise ValueError("channels must be a multiple of heads, and of 2 heads if enhanced")

    @property
    def enhanced(self) -> bool:
        """Whether this is the enhanced decoder rather than the paper's."""
        return self.position == "rotary"

    @property
    def gaussians_per_pixel(self) -> float:
        """m of the paper."""
        return (self.seeds / self.window * self.shuffle[0] * self.shuffle[1]) ** 2

    def __str__(self) -> str:
        return (
            f"{'enhanced' if self.enhanced else 'paper'}, {self.channels} channels, "
            f"{self.heads} heads, window {self.window}, {self.seeds}x{self.seeds} seeds, "
            f"{self.cross_blocks}x{self.cross_layers} injection and "
            f"{self.self_blocks}x{self.self_layers} interaction layers"
        )


class GaussianDecoder(nn.Module):
    def __init__(self, config: DecoderConfig, in_channels: int) -> None:
        super().__init__()
        self.config = config
        c, dim = config, config.channels
        self.gs_embedding = nn.Parameter(torch.randn(c.seeds**2, dim))
        self.pos_embedding = nn.Parameter(torch.randn(c.seeds**2, dim))
        self.img_feat_proj = nn.Sequential(
            nn.Conv2d(in_channels, dim, 3, padding=1), nn.ReLU(), nn.Conv2d(dim, dim, 3, padding=1)
        )
        self.window_crossattn_blocks = nn.ModuleList(
            Block(config, CrossLayer, c.cross_layers) for _ in range(c.cross_blocks)
        )
        self.gs_selfattn_blocks = nn.ModuleList(
            Block(config, SelfLayer, c.self_layers) for _ in range(c.self_blocks)
        )
        if config.enhanced:
            self.conv_final = nn.Conv2d(dim, dim, 3, padding=1)
        self.scale_mlp = nn.Sequential(nn.Linear(1, 4 * dim), nn.ReLU(), nn.Linear(4 * dim, dim))
        self.UPNet = nn.Sequential(
            nn.Conv2d(dim, dim * c.shuffle[0] ** 2, 3, padding=1),
            nn.PixelShuffle(c.shuffle[0]),
            nn.Conv2d(dim, dim * c.shuffle[1] ** 2, 3, padding=1),
            nn.PixelShuffle(c.shuffle[1]),
        )
        for name, columns in HEADS.items():
            self.add_module(f"mlp_block_{name}", head(dim, c.head_expansion * dim, columns))

    def forward(self, features: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        """(B, in_channels, h, w) features, (B,) scale -> (B, N, 9) raw Gaussians.

        h and w are multiples of the window. The columns are those of the released kernel: sigma
        (along y, along x), rho, alpha, R, G, B, then the mean as a fraction (x, y) of the
        picture's width and height; N runs row by row over the fine grid.
        """
        window, seeds = self.config.window, self.config.seeds
        b, _, h, w = features.shape
        if h % window or w % window or not h or not w:
            raise RequestError(f"Feature sides must be multiples of {window}, but are {h}x{w}.")
        down, across = h // window, w // window
        embedding = self.scale_mlp(1 / scale.view(b, 1).to(features.dtype))  # [B, C]
        guide = self.img_feat_proj(features).permute(0, 2, 3, 1)  # [B, h, w, C]
        seeds_grid = self.gs_embedding.view(1, seeds, seeds, -1)
        tokens = seeds_grid.repeat(b, down, across, 1)  # [B, seeds*down, seeds*across, C]
        for block in self.window_crossattn_blocks:
            tokens = block(tokens, self.pos_embedding, guide, embedding)
        injected = tokens
        for block in self.gs_selfattn_blocks:
            tokens = block(tokens, embedding)
        if self.config.enhanced:
            tokens = on_grid(self.conv_final, tokens)
        fine = self.UPNet((tokens + injected).permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        return self._read(fine)

    def _read(self, fine: torch.Tensor) -> torch.Tensor:
        """(B, Gy, Gx, C) tokens of the fine grid -> (B, Gy * Gx, 9) raw columns."""
        rows, columns = fine.shape[1:3]
        heads = [self.get_submodule(f"mlp_block_{name}") for name in HEADS]
        # A few rows at a time, so that hidden layers stay in the cache; autograd keeps all anyway.
        some = rows if torch.is_grad_enabled() else max(1, CACHED // columns)
        parts = [torch.cat([head(part) for head in heads], -1) for part in fine.split(some, dim=1)]
        activations, offset = torch.cat(parts, dim=1).split((7, 2), dim=-1)
        x = torch.arange(columns, device=fine.device) + 0.5
        y = torch.arange(rows, device=fine.device) + 0.5
        cells = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)  # [Gy, Gx, 2]
        extent = cells.new_tensor([columns, rows])
        mean = offset / extent + cells / extent
        return torch.cat([activations, mean], dim=-1).flatten(1, 2)

    def initialise(self) -> None:
        """Start with small, grey, overlapping Gaussians whose opacities sum to mid-grey."""
        # std starts at sigmoid(0) / 1.2 = 0.417 px; each Gaussian covers 2 pi std^2 = 1.09 px^2
        # with colour 0.5, so the opacities of one pixel must add up to about 0.9.
        share = min(0.5, 0.9 / self.config.gaussians_per_pixel)
        with torch.no_grad():
            for name in HEADS:
                last = self.get_submodule(f"mlp_block_{name}")[4]
                last.weight.mul_(0.3 if name == "rgb" else 0.1)
            self.get_submodule("mlp_block_alpha")[4].bias.fill_(math.log(share / (1 - share)))
        for block in self.window_crossattn_blocks:
            for layer in block.blocks:
                if not layer.shift:
                    layer.window_cross_attn.look_at_own_position()

    @staticmethod
    def config_from(state: State) -> DecoderConfig:
        """The configuration that has tensors of these shapes.

        Of the window, rotary attention stores nothing where it is smaller than the seeds' grid;
        then the window is taken to be as wide as that. Raises KeyError, ValueError.
        """
        cross, own = "window_crossattn_blocks", "gs_selfattn_blocks"
        dim = state["gs_embedding"].shape[1]
        seeds = side(len(state["gs_embedding"]))
        attention = f"{cross}.0.blocks.0.window_cross_attn"
        if f"{attention}.rope_freqs" in state:
            position, heads = "rotary", state[f"{attention}.rope_freqs"].shape[1]
            window = side(len(state[f"{attention}.rope_t_x"]))
        else:
            position, heads = "bias", state[f"{attention}.relative_position_bias_table"].shape[1]
            window = side(state[f"{attention}.relative_position_index"].shape[1])
        return DecoderConfig(
            channels=dim,
            heads=heads,
            window=window,
            seeds=seeds,
            cross_blocks=count(state, cross),
            cross_layers=count(state, f"{cross}.0.blocks"),
            self_blocks=count(state, own),
            self_layers=count(state, f"{own}.0.blocks"),
            shuffle=tuple(side(len(state[f"UPNet.{i}.weight"]) // dim) for i in (0, 2)),
            head_expansion=len(state["mlp_block_sigma.2.weight"]) // dim,
            position=position,
        )


def head(dim: int, hidden: int, columns: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(dim, dim),
        nn.ReLU(inplace=True),
        nn.Linear(dim, hidden),
        nn.ReLU(inplace=True),
        nn.Linear(hidden, columns),
    )


def unused(layer: nn.Module) -> nn.Module:
    """A layer that only feeds the query that does not matter: kept for checkpoints, not trained."""
    return layer.requires_grad_(False)


class Block(nn.Module):
    """Layers, every second one over shifted windows, then an MLP, around a residual connection.

    layer: CrossLayer or SelfLayer.
    """

    def __init__(self, config: DecoderConfig, layer: type[nn.Module], layers: int) -> None:
        super().__init__()
        dim = config.channels
        self.mlp = nn.Sequential(nn.Linear(dim, dim), nn.ReLU(), nn.Linear(dim, dim))
        self.norm = nn.LayerNorm(dim)
        self.blocks = nn.ModuleList(layer(config, shifted=i % 2 == 1) for i in range(layers))
        self.conv = nn.Conv2d(dim, dim, 3, padding=1) if config.enhanced else None

    def forward(self, tokens: torch.Tensor, *context: torch.Tensor) -> torch.Tensor:
        """(B, H, W, C) tokens -> the same. context: whatever else the layers look at."""
        x = self.norm(tokens)
        for layer in self.blocks:
            x = layer(x, *context)
        x = self.mlp(x)
        return tokens + (on_grid(self.conv, x) if self.conv else x)


class CrossLayer(nn.Module):
    """Condition injection: Gaussian tokens look at the features of their window."""

    def __init__(self, config: DecoderConfig, shifted: bool) -> None:
        super().__init__()
        dim = config.channels
        self.window, self.seeds = config.window, config.seeds
        self.shift = config.window // 2 if shifted else 0
        self.norm1 = unused(nn.LayerNorm(dim))
        self.norm2 = nn.LayerNorm(dim)
        self.norm3 = nn.LayerNorm(dim)
        self.norm4 = nn.LayerNorm(dim)
        self.gs_cross_attn_scale = ScaleAttention(dim)
        self.window_cross_attn = WindowAttention(
            dim, config.heads, config.seeds, config.window, config.position
        )
        self.mlp_crossattn_scale = MLP(dim)
        self.mlp_crossattn_feature = MLP(dim)

    def forward(self, x, positions, guide, embedding):
        # x [B, H, W, C]; positions [seeds^2, C]; guide [B, h, w, C]; embedding [B, C]
        x = x + self.gs_cross_attn_scale(embedding)
        x = x + self.mlp_crossattn_scale(self.norm2(x))
        queries = to_windows(self.norm3(x), self.seeds) + positions
        # The released weights roll the features, wrap around, use no mask and roll nothing back.
        shifted = guide.roll((-self.shift, -self.shift), (1, 2)) if self.shift else guide
        attended = self.window_cross_attn(queries, to_windows(shifted, self.window))
        x = x + from_windows(attended, self.seeds, *x.shape[1:3])
        return x + self.mlp_crossattn_feature(self.norm4(x))


class SelfLayer(nn.Module):
    """Gaussian interaction: tokens of a window attend to each other."""

    def __init__(self, config: DecoderConfig, shifted: bool) -> None:
        super().__init__()
        dim = config.channels
        self.seeds = config.seeds
        self.shift = config.seeds // 2 if shifted else 0
        self.norm1 = nn.LayerNorm(dim)
        self.norm2 = nn.LayerNorm(dim)
        self.norm3 = unused(nn.LayerNorm(dim))
        self.norm4 = nn.LayerNorm(dim)
        self.gs_self_attn = WindowAttention(
            dim, config.heads, config.seeds, config.seeds, config.position
        )
        self.mlp_selfattn = MLP(dim)
        self.gs_cross_attn_scale = ScaleAttention(dim)
        self.mlp_crossattn = MLP(dim)

    def forward(self, x, embedding):
        # x [B, H, W, C]; embedding [B, C]. Shifted windows wrap around, without a mask.
        x = x + self.gs_cross_attn_scale(embedding)
        x = x + self.mlp_crossattn(self.norm4(x))
        grid = self.norm1(x)
        if self.shift:
            grid = grid.roll((-self.shift, -self.shift), (1, 2))
        windows = to_windows(grid, self.seeds)
        attended = from_windows(self.gs_self_attn(windows, windows), self.seeds, *x.shape[1:3])
        if self.shift:
            attended = attended.roll((self.shift, self.shift), (1, 2))
        x = x + attended
        return x + self.mlp_selfattn(self.norm2(x))
