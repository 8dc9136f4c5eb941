"""Entry point: check the input and call a backend."""

import math

from torch import Tensor

from rewild4d.rasterizer import backends
from rewild4d.rasterizer.checks import check_cameras, check_gaussians, check_values
from rewild4d.rasterizer.conventions import EPS2D, RasterInput, Rendered


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    width: int,
    height: int,
    *,
    background: Tensor | None = None,
    eps2d: float = EPS2D,
    antialias: bool = False,
    near: float = 0.01,
    backend: str = "auto",
) -> Rendered:
    """Blend 3D Gaussians front to back into images (design note "The one rasterizer"; semantics of gsplat).

    Differentiable in every tensor argument. Values and gradients are the same bits for any number of threads.

    Args:
        means: centres in the world, [N, 3].
        quats: orientations, wxyz, of any length (normalised here; zero is the identity), [N, 4].
        scales: standard deviations along the Gaussian's own axes, [N, 3].
        opacities: in [0, 1], [N].
        features: any number of channels (colour, normal, depth, part), magnitudes up to `checks.MOST_FEATURE`, [N, C].
        world_to_camera: OpenCV axes; converted to the dtype and device of ``means``, [V, 4, 4].
        intrinsics: pinhole without skew, pixel centres at +0.5; converted likewise, [V, 3, 3].
        width: image width in pixels.
        height: image height in pixels.
        background: composited behind everything, [C] or [V, C]; None leaves the features premultiplied (black).
        eps2d: variance in square pixels added to every projected Gaussian.
        antialias: scale opacity down by what ``eps2d`` adds in area, so that far objects do not grow.
        near: Gaussians whose centre is not farther than this along the camera's z are not drawn.
        backend: "numba" (float32 on the CPU), "triton" or "gsplat" (float32 on a CUDA GPU), "reference" (dense torch,
            any device and float type, small scenes only) or "auto": the process's choice (`set_default`) where it
            takes these tensors, else the fastest that does, else the reference.

    Returns:
        Features [V, C, height, width], alpha [V, 1, height, width], and the info that densification needs.

    Raises:
        ValueError: a shape, type, device or option is wrong, or a value is not finite or too large.
    """
    named = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "features": features}
    check_gaussians(named)
    world_to_camera, intrinsics = world_to_camera.to(means), intrinsics.to(means)
    check_cameras(world_to_camera, intrinsics, width, height)
    views, channels = world_to_camera.shape[0], features.shape[1]
    named |= {"world_to_camera": world_to_camera, "intrinsics": intrinsics}
    if background is not None:
        if background.shape not in ((channels,), (views, channels)):
            raise ValueError(
                f"background: expected shape [{channels}] or [{views}, {channels}], got {list(background.shape)}."
            )
        background = background.to(means).expand(views, channels)
        named["background"] = background
    if not (0 <= eps2d < math.inf and 0 < near < math.inf):
        raise ValueError(f"expected finite eps2d >= 0 and near > 0, got eps2d={eps2d} and near={near}.")
    name = backends.resolve(backend, means.device, means.dtype)
    if name not in backends.CHECK_VALUES:
        check_values(named)
    given = RasterInput(
        means, quats, scales, opacities, features, world_to_camera, intrinsics,
        int(width), int(height), background, float(eps2d), bool(antialias), float(near),
    )  # fmt: skip
    return backends.load(name)(given)
