"""Run the GPU's small kernels and their torch twins on the same numbers; print the errors as JSON.

`python triton_twins.py cpu`, with TRITON_INTERPRET=1 in the environment, or `python triton_twins.py cuda`.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from rewild4d.harmonics import seen_colors
from rewild4d.kernels import gpu
from rewild4d.kernels.gpu_images import colour_sums
from rewild4d.ours.canonical import REST_GAIN, Gaussians
from rewild4d.ours.losses import regularizers
from rewild4d.ours.losses.images import C1, C2, colour_losses
from rewild4d.ours.symmetry import Target
from rewild4d.transforms import quat_multiply
from rewild4d.types import Camera, Splats

COUNT = 300
"""Of Gaussians: three blocks, the last one not full."""


def compare(made: Callable[..., Tensor], twin: Callable[..., Tensor], *inputs: Tensor, learns: int) -> list[float]:
    """Relative errors of the result and of the gradients of the first ``learns`` inputs, the twin in float64."""
    found = []
    for call, dtype in ((made, torch.float32), (twin, torch.float64)):
        leaves = [part.to(dtype, copy=True).requires_grad_(index < learns) for index, part in enumerate(inputs)]
        result = call(*leaves)
        weights = torch.randn(result.shape, generator=torch.Generator().manual_seed(9)).to(result)
        if learns:
            (result * weights).sum().backward()
        found.append([result.detach(), *(leaf.grad for leaf in leaves[:learns])])
    return [float((one.double() - other).norm() / other.norm()) for one, other in zip(*found, strict=True)]


def plain_sums(rgb: Tensor, alpha: Tensor, shown: Tensor, mask: Tensor, colour: Tensor) -> tuple[Tensor, Tensor]:
    """What `colour_losses` says, times its area."""
    camera = Camera(torch.eye(4), torch.eye(3), rgb.shape[2], rgb.shape[1])
    whole = slice(0, rgb.shape[1]), slice(0, rgb.shape[2])
    target = Target(shown.cpu(), mask.cpu(), camera, 3**-0.5)
    return tuple(loss.to(rgb) for loss in colour_losses(rgb.cpu(), alpha.cpu(), target, colour.cpu(), whole))  # type: ignore[return-value]


def errors(device: str) -> dict[str, list[float]]:
    """Errors of every kernel by name."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator).to(device)

    quats, others, means, log_scales, eye = (
        normal(COUNT, 4),
        normal(COUNT, 4),
        *(normal(COUNT, 3), normal(COUNT, 3)),
        normal(3),
    )
    unit = torch.nn.functional.normalize(others, dim=-1)
    found = {
        "multiply": compare(gpu.multiply, quat_multiply, quats, others, learns=2),
        "smallest axes": compare(gpu.smallest_axes, regularizers._normals, quats, log_scales, means, eye, learns=1),
    }
    for degree, coefficients in ((1, 4), (2, 16), (3, 16)):
        colors = 5 * normal(COUNT, coefficients, 3)

        def seen(colors: Tensor, degree: int = degree) -> Tensor:
            return gpu.seen_rgb(colors, means, unit, quats, eye, degree, REST_GAIN)

        def twin(colors: Tensor, degree: int = degree) -> Tensor:
            values = {"means": means, "quats": quats, "log_scales": means, "logit_opacities": means[:, 0]}
            own = Gaussians(values | {"colors": colors}, 1.0).double()
            del own.colors
            own.__dict__["colors"] = colors
            return own.seen_rgb(means.double(), unit.double(), eye.double(), degree)

        found[f"colours of degree {degree}"] = compare(seen, twin, colors, learns=1)
    splats = Splats(means, unit, means.exp(), means[:, 0].sigmoid(), 0.5 * normal(COUNT, 16, 3))

    def shaded(colors: Tensor) -> Tensor:
        if colors.dtype == torch.float32:
            return gpu.splat_colors(colors, means, eye)
        return seen_colors(replace(splats, colors=colors, means=means.double()), eye)

    found["colours of splats"] = compare(shaded, shaded, splats.colors, learns=0)
    rgb, shown, alpha, mask = normal(3, 37, 45), normal(3, 37, 45), normal(1, 37, 45), normal(1, 37, 45)
    rgb, shown, alpha, mask = (part.sigmoid() for part in (rgb, shown, alpha, mask))
    colour = torch.tensor((0.2, 0.9, 1.0), device=device)
    found["L1 and SSIM"] = compare(
        lambda *images: torch.stack(colour_sums(*images, shown, mask, colour, C1, C2)),
        lambda *images: torch.stack(plain_sums(*images, shown.double(), mask.double(), colour.double())),
        rgb, alpha, learns=2,
    )  # fmt: skip
    halves = normal(21, 3, 3) + 3 * torch.eye(3, device=device)
    positive = halves @ halves.mT

    def top(matrices: Tensor) -> Tensor:
        axes = torch.linalg.eigh(matrices)[1][..., -1] if matrices.dtype == torch.float64 else gpu.top_axes(matrices)
        return axes * axes.sum(-1, keepdim=True).sign()

    found["top axes"] = compare(top, top, positive, learns=0)
    return found


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(errors(sys.argv[1])))
