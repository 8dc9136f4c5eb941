"""Arithmetic lower bound of the time that this machine needs for an image's blends.

    lower bound [s] = B F / R

    B  useful blends: pairs (pixel, Gaussian) with alpha >= 1/255 before the pixel is opaque, counted exactly
    F  floating point operations of a blend of three channels: 40 forward, 110 forward and backward
    R  operations a second: fused multiply-adds on 16 lanes and all threads (on a GPU: floor_cuda.py)

Projection, sorting, culling and memory count as zero, so no program can reach the bound.
"""

import math
from typing import NamedTuple

import numpy as np
import torch

from rewild4d.benchmarks.scenes import SplatScene
from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.simd import LANES, fma, load, splat, store
from rewild4d.kernels.threads import run, thread_count
from rewild4d.rasterizer.conventions import EPS2D, FRUSTUM_MARGIN, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from rewild4d.transforms import quat_to_matrix

FLOPS_FORWARD, FLOPS_BOTH = 40, 110
"""Operations of a useful blend: forward, and forward with backward."""
CHAINS = (4, 8)
"""Independent chains of multiply-adds: 8 hide their latency in 32 registers (AVX-512, NEON), 4 fit into 16 (AVX2)."""
ROUNDS = 1_000_000
"""Length of each chain in one call, which takes a millisecond or two."""


def floor_ms(blends: int, flops: int, gflops: float) -> float:
    """Compute the lower bound in milliseconds."""
    return blends * flops / (gflops * 1e9) * 1e3


def multiply_adds(chains: int) -> None:
    """Do `multiply_adds_flops` operations on all threads."""
    start = np.linspace(0.1, 0.9, LANES, dtype=np.float32)
    calls = [(start, np.empty(LANES, np.float32), ROUNDS) for _ in range(thread_count())]
    run(_four_chains if chains == 4 else _eight_chains, calls)


def multiply_adds_flops(chains: int) -> int:
    """Return the operations of one call of `multiply_adds`: a multiplication and an addition in every lane."""
    return 2 * LANES * chains * ROUNDS * thread_count()


@kernel
def _four_chains(start: np.ndarray, end: np.ndarray, rounds: int) -> None:
    """Run independent chains of multiply-adds; their start is an argument, so that nothing is folded."""
    x, y = load(start, 0), splat(np.float32(0.5))
    a, b, c, d = x, x + y, x - y, x * y
    for _ in range(rounds):
        a, b, c, d = fma(a, x, y), fma(b, x, y), fma(c, x, y), fma(d, x, y)
    store(end, 0, a + b + c + d)


@kernel
def _eight_chains(start: np.ndarray, end: np.ndarray, rounds: int) -> None:
    """Run twice as many."""
    x, y = load(start, 0), splat(np.float32(0.5))
    a, b, c, d = x, x + y, x - y, x * y
    e, f, g, h = a + b, b + c, c + d, d + a
    for _ in range(rounds):
        a, b, c, d = fma(a, x, y), fma(b, x, y), fma(c, x, y), fma(d, x, y)
        e, f, g, h = fma(e, x, y), fma(f, x, y), fma(g, x, y), fma(h, x, y)
    store(end, 0, a + b + c + d + e + f + g + h)


class Blends(NamedTuple):
    """Useful blends, pixel by pixel in the order of the image, front to back in each."""

    pixels: np.ndarray  # row * size + column, int64, [M]
    gaussians: np.ndarray  # index, int64, [M]


def count_blends(scene: SplatScene) -> int:
    """Count the useful blends."""
    nothing = np.empty(0, np.int64)
    return _walk(*_projected(scene), scene.size, nothing, nothing)


def list_blends(scene: SplatScene) -> Blends:
    """List the useful blends."""
    pixels, gaussians = np.empty((2, count_blends(scene)), np.int64)
    _walk(*_projected(scene), scene.size, pixels, gaussians)
    order = np.argsort(pixels, kind="stable")
    return Blends(pixels[order], gaussians[order])


def _projected(scene: SplatScene) -> tuple[np.ndarray, ...]:
    """Return index [n], centre [n, 2], covariance (xx, xy, yy) [n, 3], opacity [n], front to back, pixels, float64."""
    means, quats, scales, opacities, _ = (tensor.detach().double().numpy() for tensor in scene.gaussians)
    matrix, pinhole = scene.world_to_camera[0].double().numpy(), scene.intrinsics[0].double().numpy()
    local = means @ matrix[:3, :3].T + matrix[:3, 3]
    depth, focal, centre = local[:, 2:], pinhole[(0, 1), (0, 1)], pinhole[:2, 2]
    tangent = local[:, :2] / depth
    margin = FRUSTUM_MARGIN * 0.5 * scene.size / focal
    clipped = np.clip(tangent, -centre / focal - margin, (scene.size - centre) / focal + margin)
    linear = (focal / depth)[:, :, None] * (matrix[None, :2, :3] - clipped[:, :, None] * matrix[None, 2:3, :3])
    half = linear @ quat_to_matrix(torch.from_numpy(quats)).numpy() * scales[:, None, :]
    covariance = half @ half.transpose(0, 2, 1) + EPS2D * np.eye(2)
    order = np.argsort(local[:, 2].astype(np.float32), kind="stable")
    order = order[local[order, 2] > 0.01]
    upper = covariance[:, (0, 0, 1), (0, 1, 1)]
    return order, (tangent * focal + centre)[order], upper[order], opacities[order]


@kernel
def _walk(
    index: np.ndarray, centers: np.ndarray, covariances: np.ndarray, opacities: np.ndarray, size: int,
    pixels: np.ndarray, gaussians: np.ndarray,
) -> int:  # fmt: skip
    """Blend front to back, Gaussian by Gaussian over its rectangle; count the blends, and list as many as have room."""
    left = np.ones((size, size))
    count = 0
    for k in range(len(index)):
        xx, xy, yy = covariances[k, 0], covariances[k, 1], covariances[k, 2]
        det = xx * yy - xy * xy
        support = 2 * math.log(max(opacities[k] / MIN_ALPHA, 1.0))
        wide, high = math.sqrt(support * xx), math.sqrt(support * yy)
        for row in range(max(0, int(centers[k, 1] - high - 0.5)), min(size, int(centers[k, 1] + high + 1.5))):
            for column in range(max(0, int(centers[k, 0] - wide - 0.5)), min(size, int(centers[k, 0] + wide + 1.5))):
                dx, dy = column + 0.5 - centers[k, 0], row + 0.5 - centers[k, 1]
                square = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det
                alpha = min(MAX_ALPHA, opacities[k] * math.exp(-0.5 * square))
                if alpha < MIN_ALPHA or left[row, column] == 0:
                    continue
                after = left[row, column] * (1 - alpha)
                if after <= MIN_TRANSMITTANCE:
                    left[row, column] = 0  # closed before this Gaussian
                    continue
                left[row, column] = after
                if count < len(pixels):
                    pixels[count] = row * size + column
                    gaussians[count] = index[k]
                count += 1
    return count
