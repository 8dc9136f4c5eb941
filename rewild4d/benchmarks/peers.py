"""Rasterizers to compare with: gsplat and our dense reference.

On a GPU gsplat runs its CUDA kernels. On a CPU, of all splat rasterizers on PyPI, only gsplat's torch implementation of
them runs, `gsplat.cuda._torch_impl`. Its parts in CUDA are replaced in its favour: the list of useful (pixel, Gaussian)
pairs is given and not timed, and two functions of nerfacc, which blend along that list, are written in torch.
"""

import math
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module, metadata
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from rewild4d.benchmarks.floor import list_blends
from rewild4d.benchmarks.scenes import SplatScene
from rewild4d.rasterizer.conventions import EPS2D

Render = Callable[[tuple[Tensor, ...]], Tensor]
"""From a scene's five tensors to its image on black, [3, size, size], differentiable."""
MOST_DENSE = 20_000_000
"""Gaussians times pixels beyond which the dense reference needs too much memory."""
SAME_PSNR = 50.0
"""Least PSNR (dB) against our image for a peer to be timed."""


class NotTimed(Exception):
    """A peer cannot be timed here; the message is the reason."""


@dataclass(frozen=True)
class Peer:
    """One competitor."""

    name: str  # as the table prints it
    package: str  # on PyPI; "" for a part of rewild4d
    prepare: Callable[[SplatScene], Render]  # returns the renderer of a scene, or raises `NotTimed`
    note: str = ""  # what its time leaves out


def installed(peers: tuple[Peer, ...]) -> dict[str, str]:
    """Return the versions of the peers' installed packages."""
    versions = {}
    for package in {peer.package: None for peer in peers if peer.package}:
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return versions


def psnr(image: Tensor, other: Tensor) -> float:
    """Compute the peak signal-to-noise ratio in dB of two images in [0, 1]; infinite where they are equal."""
    error = float((image.double() - other.double()).square().mean())
    return 10 * math.log10(1 / error) if error > 0 else math.inf


def _dense_reference(scene: SplatScene) -> Render:
    dense = len(scene) * scene.size**2
    if dense > MOST_DENSE:
        raise NotTimed(f"not timed: {dense:.1e} Gaussians x pixels, more than {MOST_DENSE:.0e}, need too much memory")
    return lambda gaussians: scene.render(gaussians, backend="reference")[0]


def _part_of_gsplat(module: str) -> Any:
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name == "gsplat":
            raise NotTimed("not installed: pip install gsplat") from error
        raise NotTimed(f"gsplat is installed, but needs {error.name}: pip install {error.name}") from error
    except Exception as error:  # a foreign package may fail in any way while it looks for CUDA
        raise NotTimed(f"gsplat is installed, but does not import: {error}") from error


def _gsplat_twin(scene: SplatScene) -> Render:
    twin = _part_of_gsplat("gsplat.cuda._torch_impl")
    blends = list_blends(scene)
    chosen, pixels = torch.from_numpy(blends.gaussians), torch.from_numpy(blends.pixels)
    images, size = torch.zeros_like(pixels), scene.size
    nerfacc: Any = SimpleNamespace(render_weight_from_alpha=_weights, accumulate_along_rays=_accumulate)

    def render(gaussians: tuple[Tensor, ...]) -> Tensor:
        means, quats, scales, opacities, colors = gaussians
        covariances, _ = twin._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        _, centers, _, conics, _ = twin._fully_fused_projection(
            means, covariances, scene.world_to_camera, scene.intrinsics, size, size, eps2d=EPS2D
        )
        with patch.dict(sys.modules, nerfacc=nerfacc):
            image, _ = twin.accumulate(
                centers, conics, opacities[None], colors[None], chosen, pixels, images, size, size
            )
        return image[0].permute(2, 0, 1)

    return render


def _weights(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """Return weight and transmittance of each entry, [M]; those of a pixel are consecutive, front to back."""
    logs = torch.log1p(-alphas.double())  # summed over the whole image, so in double precision
    before = logs.cumsum(0) - logs
    counts = torch.bincount(ray_indices, minlength=n_rays)
    first = (counts.cumsum(0) - counts)[ray_indices]
    transmittance = (before - before[first]).exp().to(alphas)
    return alphas * transmittance, transmittance


def _accumulate(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Return the weighted sum per pixel, or that of the weights without values, [n_rays, C]."""
    terms = weights[:, None] if values is None else weights[:, None] * values
    return terms.new_zeros(n_rays, terms.shape[1]).index_add(0, ray_indices, terms)


def _gsplat_kernels(scene: SplatScene) -> Render:
    gsplat = _part_of_gsplat("gsplat")
    if _part_of_gsplat("gsplat.cuda._backend")._C is None:
        raise NotTimed("gsplat is installed, but has no kernels here: it builds them with nvcc, or a wheel has them")
    cameras = (scene.world_to_camera, scene.intrinsics, scene.size, scene.size)

    def render(gaussians: tuple[Tensor, ...]) -> Tensor:
        image, _, _ = gsplat.rasterization(*gaussians, *cameras, eps2d=EPS2D, packed=False)
        return image[0].permute(2, 0, 1)

    return render


CUDA_PEERS = (
    Peer("gsplat", "gsplat", _gsplat_kernels, "called without rewild4d's checks of the input"),
    Peer("dense torch reference", "", _dense_reference),
)
"""Peers of the Triton backend, on a GPU."""
PEERS = (
    Peer("gsplat's torch twin", "gsplat", _gsplat_twin, "its list of pairs is given and costs no time"),
    Peer("dense torch reference", "", _dense_reference),
)
