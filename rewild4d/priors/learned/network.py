"""The network: each picture alone gives heat maps and depths of the points, then attention over time corrects them."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, interpolate, relu, scaled_dot_product_attention

from rewild4d.kernels.compiling import compiled_for
from rewild4d.priors.learned.pictures import LENGTH, Examples
from rewild4d.priors.learned.points import NAMES

STAGES = ((32, 1), (64, 1), (128, 2), (256, 1))
"""Width and residual blocks of each stage of the encoder; each but the first halves the picture."""
MAP = 24
"""Side of the heat maps: a quarter of the picture's."""
FEATURES = 256
VECTORS = 48
"""Features that are directions in space: three numbers each, turned with the camera."""
HEADS, BLOCKS, REACH = 4, 3, LENGTH - 1
"""Attention heads and blocks; frames apart beyond which the learned bias is that of the last."""
ALONE = 1.0
"""Weight of the error of what each picture says alone."""


@dataclass(frozen=True)
class Found:
    """What the network says of a sequence.

    Attributes:
        points: in units of half the crop's width, about the root, in each camera's axes, [b, t, L, 3].
        spreads: expected absolute error across the view and along it, [b, t, L, 2].
        alone: what each picture says without the others, as ``points``.
    """

    points: Tensor
    spreads: Tensor
    alone: Tensor


def _block(before: int, width: int, stride: int) -> list[nn.Module]:
    return [nn.Conv2d(before, width, 3, stride, 1, bias=False), nn.GroupNorm(8, width), nn.ReLU()]


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.second = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.norms = nn.ModuleList(nn.GroupNorm(8, width) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        inside = relu(self.norms[0](self.first(x)))
        return relu(x + self.norms[1](self.second(inside)))


class _Eye(nn.Module):
    """A picture [n, 2, 96, 96] and what is known of its camera [n, 5] -> features [n, F], heat maps and depths."""

    def __init__(self) -> None:
        super().__init__()
        stages, before = [], 2
        for index, (width, blocks) in enumerate(STAGES):
            entry = _block(before, width, 2)
            if index == 0:
                entry = [*_block(before, width // 2, 2), *_block(width // 2, width, 2)]
            stages.append(nn.Sequential(*entry, *(_Residual(width) for _ in range(blocks))))
            before = width
        self.stages = nn.ModuleList(stages)
        self.last = nn.Sequential(nn.Linear(9 * before + 5, 2 * FEATURES), nn.GELU(), nn.Linear(2 * FEATURES, FEATURES))
        fine, middle, coarse, _ = (width for width, _ in STAGES)
        self.lateral = nn.ModuleList((nn.Conv2d(coarse, middle, 1), nn.Conv2d(middle, fine, 1)))
        self.whole = nn.Linear(FEATURES, fine)
        self.smooth = nn.ModuleList(
            (nn.Sequential(*_block(middle, middle, 1)), nn.Sequential(*_block(fine, 2 * fine, 1)))
        )
        self.heat, self.depth = nn.Conv2d(2 * fine, len(NAMES), 1), nn.Linear(FEATURES, len(NAMES))

    def forward(self, pictures: Tensor, camera: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, kept = pictures.contiguous(memory_format=torch.channels_last), []
        for stage in self.stages:
            x = stage(x)
            kept.append(x)
        features = self.last(torch.cat((x.flatten(1).float(), camera), dim=1))
        x = self.smooth[0](kept[1] + interpolate(self.lateral[0](kept[2]), scale_factor=2.0))
        x = kept[0] + interpolate(self.lateral[1](x), scale_factor=2.0) + self.whole(features)[..., None, None]
        return features, self.heat(self.smooth[1](x)).float().flatten(2), self.depth(features)


def _read_maps(heat: Tensor, along: Tensor, openings: Tensor) -> tuple[Tensor, Tensor]:
    """Return points [n, L, 3] and the width of their heat [n, L].

    From heat maps [n, L, MAP * MAP], depths [n, L] and openings [n].
    """
    share, along = heat.softmax(-1), along.float()
    line = (torch.arange(MAP, device=heat.device) + 0.5) * (2 / MAP) - 1
    grid = torch.stack((line.expand(MAP, MAP), line[:, None].expand(MAP, MAP)), -1).reshape(-1, 2)
    place = share @ grid
    width = (share @ grid.square() - place.square()).sum(-1).clamp_min(1e-6).sqrt()
    # the picture shows x over 1 + z times the opening
    across = place * (1 + along * openings[:, None]).clamp_min(0.3)[..., None]
    return torch.cat((across, along[..., None]), dim=-1), width


class _Attention(nn.Module):
    """One block over time, with a learned bias for each distance in frames."""

    def __init__(self) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(FEATURES) for _ in range(2))
        self.inward, self.outward = nn.Linear(FEATURES, 3 * FEATURES), nn.Linear(FEATURES, FEATURES)
        self.wide, self.narrow = nn.Linear(FEATURES, 2 * FEATURES), nn.Linear(2 * FEATURES, FEATURES)
        self.bias = nn.Parameter(torch.zeros(HEADS, 2 * REACH + 1))

    def forward(self, x: Tensor) -> Tensor:
        count = x.shape[1]
        apart = torch.arange(count, device=x.device)
        bias = self.bias[:, (apart - apart[:, None]).clamp(-REACH, REACH) + REACH]
        q, k, v = self.inward(self.norms[0](x)).unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        mixed = scaled_dot_product_attention(q, k, v, attn_mask=bias.to(q)).transpose(1, 2).flatten(-2)
        x = x + self.outward(mixed)
        inside: Tensor = self.narrow(gelu(self.wide(self.norms[1](x))))
        return x + inside


class PointNetwork(nn.Module):
    """Pictures, rotations, openings and whether cameras are known (see `pictures.Examples`) -> `Found`.

    What each picture says alone, its points and the features that are directions, is turned into the world before
    frames are compared, and back into each camera afterwards: what one frame sees from the side tells another its
    depth.
    """

    def __init__(self) -> None:
        super().__init__()
        count = len(NAMES)
        self.eye = _Eye()
        self.entry = nn.Linear(FEATURES + 4 * count, FEATURES)
        self.blocks = nn.ModuleList(_Attention() for _ in range(BLOCKS))
        self.exit = nn.Linear(FEATURES, FEATURES)
        self.reading = nn.Sequential(
            nn.Linear(2 * FEATURES + 4 * count, 2 * FEATURES), nn.GELU(), nn.Linear(2 * FEATURES, 5 * count)
        )

    def forward(self, pictures: Tensor, rotations: Tensor, openings: Tensor, known: Tensor) -> Found:
        batch, count = pictures.shape[:2]
        flags = known[:, None].expand(batch, count).float()
        ups = rotations[..., :, 1] * flags[..., None]
        camera = torch.cat((ups, openings.log()[..., None] * flags[..., None], flags[..., None]), dim=-1)
        features, heat, depth = self.eye(pictures.flatten(0, 1), camera.flatten(0, 1))
        points, width = _read_maps(heat, depth, openings.flatten())
        each, alone, width = (value.unflatten(0, (batch, count)) for value in (features, points, width))
        back = rotations.transpose(-1, -2)
        world = (alone.detach() @ rotations).flatten(-2)
        x = self.entry(torch.cat((_turned(each, back), world, width), dim=-1))
        for block in self.blocks:
            x = block(x)
        mixed = _turned(self.exit(x), rotations)
        read = self.reading(torch.cat((each, mixed, alone.detach().flatten(-2), width), dim=-1))
        read = read.unflatten(-1, (len(NAMES), 5))
        return Found(alone + read[..., :3], torch.exp(read[..., 3:].clamp(-6, 3) - 2), alone)


def _turned(features: Tensor, rotations: Tensor) -> Tensor:
    """Turn the features that are directions, [b, t, F] by [b, t, 3, 3]."""
    scalars, vectors = features.split((FEATURES - 3 * VECTORS, 3 * VECTORS), dim=-1)
    vectors = vectors.unflatten(-1, (VECTORS, 3)) @ rotations.transpose(-1, -2)
    return torch.cat((scalars, vectors.flatten(-2)), dim=-1)


def loss(found: Found, points: Tensor) -> Tensor:
    """Return the negative logarithm of a Laplace density and the error of each picture alone, [b, t, L, 3] -> []."""
    away = (found.points - points).abs()
    error = torch.stack((away[..., :2].mean(-1), away[..., 2]), dim=-1)
    alone = (found.alone - points).abs().mean()
    return (error / found.spreads + found.spreads.log()).mean() + ALONE * alone


def found(network: PointNetwork, examples: Examples) -> Found:
    """Run the network on a batch, in bfloat16 where the processor multiplies it."""
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=compiled_for("avx512bf16")):
        result: Found = network(examples.pictures, examples.rotations, examples.openings, examples.known)
    return Found(result.points.float(), result.spreads.float(), result.alone.float())
