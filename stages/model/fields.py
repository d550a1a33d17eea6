"""The canonical field: signed distance, colour and 16-D embedding at a point of canonical space (section 3.1).

Two representations behind one interface:

* :class:`GridField`: dense grids at several resolutions that add up, trilinear; no network, quick on a CPU.
* :class:`MlpField`: the paper's networks, an 8 x 256 trunk over positional encodings.

Signed distance is negative inside. Colour depends on the environment code omega_e of the frame (and, in the
networks, on the viewing direction). Points are (M, 3) in canonical units, bounds (2, 3) their box.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

EMBEDDING_CHANNELS = 16


class Queried(NamedTuple):
    """What the field says at M points: signed distance (M,) and appearance features (M, C) for :meth:`shade`."""

    sdf: Tensor
    appearance: Tensor


def outside_distance(points: Tensor, bounds: Tensor) -> Tensor:
    """Distance (M,) from points (M, 3) to the box `bounds` (2, 3); zero inside."""
    beyond = torch.maximum(bounds[0] - points, points - bounds[1]).clamp_min(0)
    return torch.sqrt((beyond * beyond).sum(-1) + 1e-12) - 1e-6


def interpolation_matrix(few: int, many: int) -> Tensor:
    """(many, few): linear interpolation of `few` evenly spread values at `many` evenly spread places, ends included."""
    place = torch.arange(many, dtype=torch.float64) * ((few - 1) / max(1, many - 1))
    return (1 - (place[:, None] - torch.arange(few, dtype=torch.float64)).abs()).clamp_min(0).float()


class GridField(nn.Module):
    """Dense grids over a box: signed distance, colour and embedding, each a sum of resolutions.

    `voxel` is the finest spacing. The finest level carries detail, the coarse ones move quickly and smoothly:
    their sum behaves like a preconditioner for gradient descent.
    """

    sdf_levels = (1, 2, 4)
    colour_levels = (1, 4)
    embedding_level = 4
    bounds: Tensor
    spacing: Tensor

    def __init__(self, bounds: Tensor, voxel: float, env_channels: int) -> None:
        super().__init__()
        self.voxel = float(voxel)
        self.register_buffer("bounds", bounds.clone().float())
        cells = ((bounds[1] - bounds[0]) / voxel).round().long().clamp_min(4) + 1  # nodes along x, y, z
        self.shape = tuple(int(n) for n in cells.flip(0))  # (Z, Y, X)
        self.register_buffer("spacing", ((bounds[1] - bounds[0]) / (cells - 1)).float())

        def grid(channels: int, level: int) -> nn.Parameter:
            size = [max(3, math.ceil((n - 1) / level) + 1) for n in self.shape]
            return nn.Parameter(torch.zeros(1, channels, *size))

        self.sdf_grids = nn.ParameterList(grid(1, level) for level in self.sdf_levels)
        self.colour_grids = nn.ParameterList(grid(3, level) for level in self.colour_levels)
        self.embedding_grid = grid(EMBEDDING_CHANNELS, self.embedding_level)
        coarse = {tuple(g.shape[2:]) for g in (*self.sdf_grids, *self.colour_grids)} - {self.shape}
        for size in coarse:
            for axis, (few, many) in enumerate(zip(size, self.shape, strict=True)):
                matrix = interpolation_matrix(few, many)
                self.register_buffer(self._matrix_name(size, axis), matrix, persistent=False)
        # Colour of the surface times a gain plus a bias, both from the environment code: exposure and tint.
        self.environment = nn.Linear(env_channels, 6)
        nn.init.zeros_(self.environment.weight)
        nn.init.zeros_(self.environment.bias)

    def node_positions(self) -> Tensor:
        """Positions (Z, Y, X, 3) of the finest grid's nodes."""
        axes = [torch.linspace(float(self.bounds[0, k]), float(self.bounds[1, k]), self.shape[2 - k]) for k in range(3)]
        z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
        return torch.stack([x, y, z], -1).to(self.bounds.device)

    def set_sdf(self, values: Tensor) -> None:
        """Start from signed distances (Z, Y, X) at the nodes."""
        with torch.no_grad():
            coarse = self.sdf_grids[-1]
            coarse.copy_(F.interpolate(values[None, None], coarse.shape[2:], mode="trilinear", align_corners=True))
            for middle in list(self.sdf_grids)[1:-1]:
                middle.zero_()
            self.sdf_grids[0].copy_(values[None, None] - self._sum(self.sdf_grids[1:]))

    @staticmethod
    def _matrix_name(size: tuple[int, ...], axis: int) -> str:
        return f"up_{'x'.join(map(str, size))}_{axis}"

    def _upsampled(self, grid: Tensor) -> Tensor:
        """A coarse grid (1, C, z, y, x) at the finest nodes (1, C, Z, Y, X), trilinear.

        Axis by axis as matrix products: both ways a third of the time that general resampling takes.
        """
        size = tuple(grid.shape[2:])
        if size == self.shape:
            return grid
        up_z, up_y, up_x = (self.get_buffer(self._matrix_name(size, axis)) for axis in range(3))
        wide = up_y @ (grid @ up_x.T)
        return (up_z @ wide.flatten(3)).reshape(*grid.shape[:2], *self.shape)

    def _sum(self, grids: Iterable[Tensor]) -> Tensor:
        return cast(Tensor, sum(self._upsampled(grid) for grid in grids))

    def prepare(self) -> Tensor:
        """(1, 4, Z, Y, X): signed distance and colour logits summed over the levels, once an iteration."""
        return torch.cat([self._sum(self.sdf_grids), self._sum(self.colour_grids)], 1)

    def _sample(self, grid: Tensor, points: Tensor) -> Tensor:
        """Trilinear samples (M, C) of `grid` (1, C, Z, Y, X) at points (M, 3); the border's value beyond."""
        unit = (points - self.bounds[0]) / (self.bounds[1] - self.bounds[0]) * 2 - 1
        halves = 2 if len(points) % 2 == 0 and len(points) > 4096 else 1  # torch threads over the batch axis only
        sampled = F.grid_sample(
            grid.expand(halves, -1, -1, -1, -1),
            unit.reshape(halves, 1, 1, -1, 3),
            align_corners=True,
            padding_mode="border",
        )
        return sampled.reshape(halves, grid.shape[1], -1).transpose(1, 2).reshape(len(points), -1)

    def sdf(self, prepared: Tensor, points: Tensor) -> Tensor:
        """Signed distance (M,) at points (M, 3)."""
        return self._sample(prepared[:, :1], points)[:, 0] + outside_distance(points, self.bounds)

    def query(self, prepared: Tensor, points: Tensor) -> Queried:
        """Signed distance and appearance at points (M, 3)."""
        values = self._sample(prepared, points)
        return Queried(values[:, 0] + outside_distance(points, self.bounds), values[:, 1:])

    def shade(self, appearance: Tensor, directions: Tensor, environment: Tensor) -> Tensor:
        """Colour (M, 3) in 0..1 from appearance (M, 3), viewing directions (M, 3, unused) and omega_e (M, C)."""
        gain, bias = self.environment(environment).split(3, -1)
        return torch.sigmoid(appearance * torch.exp(gain.clamp(-2, 2)) + bias)

    def embedding(self, points: Tensor) -> Tensor:
        """Canonical embedding psi(X) (M, 16), unit length (section 3.3)."""
        return F.normalize(self._sample(self.embedding_grid, points), dim=-1, eps=1e-6)

    def resized(self, bounds: Tensor) -> GridField:
        """The same field over other bounds (2, 3): resampled where they overlap, extrapolated beyond."""
        other = GridField(bounds, self.voxel, self.environment.in_features).to(self.bounds.device)
        with torch.no_grad():
            nodes = other.node_positions().reshape(-1, 3)
            prepared = self.prepare()
            values = self.query(prepared, nodes)
            other.set_sdf(values.sdf.reshape(other.shape))
            other.colour_grids[0].copy_(values.appearance.T.reshape(1, 3, *other.shape))
            size = other.embedding_grid.shape[2:]
            axes = [torch.linspace(float(bounds[0, k]), float(bounds[1, k]), size[2 - k]) for k in range(3)]
            z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
            points = torch.stack([x, y, z], -1).reshape(-1, 3).to(self.bounds.device)
            other.embedding_grid.copy_(self._sample(self.embedding_grid, points).T.reshape(1, -1, *size))
            other.environment.load_state_dict(self.environment.state_dict())
        return other


def positional_encoding(x: Tensor, bands: int) -> Tensor:
    """gamma(x) = [x, sin(2^k pi x), cos(2^k pi x)]_k, (M, D) to (M, D (1 + 2 bands))."""
    phase = x[..., None] * (math.pi * 2.0 ** torch.arange(bands, dtype=x.dtype, device=x.device))
    return torch.cat([x, phase.sin().flatten(-2), phase.cos().flatten(-2)], -1)


class MlpField(nn.Module):
    """The paper's networks: trunk of `depth` x `width` with a skip, colour head with direction and omega_e.

    Initialised to a sphere of radius half the box (geometric initialisation of SAL; paper section 3.1).
    """

    point_bands, direction_bands = 6, 4
    bounds: Tensor

    def __init__(self, bounds: Tensor, env_channels: int, depth: int = 8, width: int = 256) -> None:
        super().__init__()
        self.register_buffer("bounds", bounds.clone().float())
        self.depth, self.width = depth, width
        encoded = 3 * (1 + 2 * self.point_bands)
        self.skip = depth // 2
        sizes = [encoded] + [width + (encoded if i == self.skip else 0) for i in range(1, depth)]
        layers = [nn.Linear(n, width) for n in sizes]
        self.trunk = nn.ModuleList(layers)
        self.sdf_head = nn.Linear(width, 1)
        self.appearance_head = nn.Linear(width, width)
        direction = 3 * (1 + 2 * self.direction_bands)
        self.colour_hidden = nn.Linear(width + direction + env_channels, width // 2)
        self.colour_out = nn.Linear(width // 2, 3)
        self.embedding_net = nn.Sequential(
            nn.Linear(encoded, width // 2), nn.ReLU(), nn.Linear(width // 2, width // 2), nn.ReLU(),
            nn.Linear(width // 2, EMBEDDING_CHANNELS),
        )  # fmt: skip
        with torch.no_grad():
            for i, layer in enumerate(layers):
                layer.weight.normal_(0, math.sqrt(2 / width))
                layer.bias.zero_()
                if i in (0, self.skip):  # the encoding's sines start silent: a smooth sphere first
                    layer.weight[:, (0 if i == 0 else width) + 3 :] = 0
                if i == self.skip:
                    layer.weight[:, width:] = 0
            self.sdf_head.weight.normal_(math.sqrt(math.pi / width), 1e-4)
            self.sdf_head.bias.fill_(-0.5)

    def _unit(self, points: Tensor) -> Tensor:
        half = (self.bounds[1] - self.bounds[0]).max() / 2
        return (points - self.bounds.mean(0)) / half

    def prepare(self) -> Tensor:
        """Nothing to share between the queries of an iteration."""
        return self.bounds

    def _trunk(self, points: Tensor) -> tuple[Tensor, Tensor]:
        encoded = positional_encoding(self._unit(points), self.point_bands)
        hidden = encoded
        for i, layer in enumerate(self.trunk):
            if i == self.skip and i > 0:
                hidden = torch.cat([hidden, encoded], -1)
            hidden = torch.relu(layer(hidden))
        half = (self.bounds[1] - self.bounds[0]).max() / 2
        return self.sdf_head(hidden)[:, 0] * half, hidden

    def sdf(self, prepared: Tensor, points: Tensor) -> Tensor:
        """Signed distance (M,) at points (M, 3)."""
        return self._trunk(points)[0]

    def query(self, prepared: Tensor, points: Tensor) -> Queried:
        """Signed distance and appearance features at points (M, 3)."""
        sdf, hidden = self._trunk(points)
        return Queried(sdf, self.appearance_head(hidden))

    def shade(self, appearance: Tensor, directions: Tensor, environment: Tensor) -> Tensor:
        """Colour (M, 3) in 0..1: ``MLP_c(X, v, omega_e)`` (equation 1)."""
        view = positional_encoding(F.normalize(directions, dim=-1), self.direction_bands)
        hidden = torch.relu(self.colour_hidden(torch.cat([appearance, view, environment], -1)))
        return torch.sigmoid(self.colour_out(hidden))

    def embedding(self, points: Tensor) -> Tensor:
        """Canonical embedding psi(X) (M, 16), unit length (section 3.3)."""
        return F.normalize(self.embedding_net(positional_encoding(self._unit(points), self.point_bands)), dim=-1)
