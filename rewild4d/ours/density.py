"""Densification and pruning with a cap (METHOD section 6): clone small, split large, drop faint or huge Gaussians."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from rewild4d.ours.canonical import NAMES, Gaussians
from rewild4d.ours.config import Density
from rewild4d.rasterizer import RasterInfo
from rewild4d.transforms import quat_to_matrix
from rewild4d.types import OBJECT_DIAGONAL


class DensityControl:
    """Collects image gradients between rounds and changes the set of Gaussians at each.

    Attributes:
        gradient: summed norm of the centre's image gradient, [n].
        seen: number of views that drew the Gaussian, [n].
        radius: largest radius over the image's longest side, [n].
    """

    def __init__(self, config: Density, count: int, device: torch.device) -> None:
        self.config = config
        self.gradient, self.seen, self.radius = (torch.zeros(count, device=device) for _ in range(3))

    def state(self) -> list[Tensor]:
        """Return what `restore` takes."""
        return [self.gradient, self.seen, self.radius]

    def restore(self, state: Sequence[Tensor]) -> None:
        """Continue from `state`; the number of Gaussians may differ from the present one."""
        self.gradient, self.seen, self.radius = (part.to(self.gradient.device).clone() for part in state)

    def observe(self, info: RasterInfo, side: float, longest: int) -> None:
        """Add one view after its backward pass; ``side`` is the animal's box, ``longest`` the image's side, pixels."""
        assert info.means2d.grad is not None, "observe comes after backward"
        radii = info.radii[0]
        drawn = radii > 0
        grad_norms = info.means2d.grad[0].norm(dim=-1) * (side / 2)
        self.gradient += torch.where(drawn, grad_norms, 0.0)
        self.seen += drawn
        torch.maximum(self.radius, radii / longest, out=self.radius)

    def round_if_due(
        self, index: int, total: int, gaussians: Gaussians, optimizer: Optimizer, generator: torch.Generator
    ) -> bool:
        """Densify and prune after the iterations that the schedule names; tell whether it did.

        Raises:
            FloatingPointError: no Gaussian is left.
        """
        config = self.config
        every = max(1, round(config.every * total))
        if not config.start * total <= index < config.end * total or (index + 1) % every:
            return False
        self.round(gaussians, optimizer, generator)
        if len(gaussians) == 0:
            raise FloatingPointError(f"iteration {index}: no Gaussian is left; every opacity fell below the limit")
        return True

    @torch.no_grad()
    def round(self, gaussians: Gaussians, optimizer: Optimizer, generator: torch.Generator) -> None:
        """Refine where the mean gradient is large, as many as the cap allows, then prune; reset the statistics."""
        config = self.config
        mean = self.gradient / self.seen.clamp_min(1)
        opacities, scales = gaussians.opacities(), gaussians.scales_log().exp()
        keep = (opacities >= config.prune_opacity) & (self.radius <= config.prune_radius)
        room = max(0, config.cap - int(keep.sum()))
        wanted = (mean > config.gradient) & keep
        if int(wanted.sum()) > room:
            order = torch.where(wanted, mean, -1.0).argsort(descending=True, stable=True)
            wanted = torch.zeros_like(wanted).index_fill_(0, order[:room], True)
        large = scales.amax(-1) > config.split_scale * OBJECT_DIAGONAL
        clone, split = (wanted & ~large).nonzero()[:, 0], (wanted & large).nonzero()[:, 0]
        stay = (keep & ~(wanted & large)).nonzero()[:, 0]
        source = torch.cat((stay, clone, split, split))
        values = {name: getattr(gaussians, name).detach()[source].clone() for name in NAMES}
        fresh = slice(len(stay) + len(clone), None)
        offset = torch.randn(2 * len(split), 3, generator=generator).to(scales) * scales[source[fresh]]
        rotation = quat_to_matrix(gaussians.quats.detach()[source[fresh]])
        values["means"][fresh] += (rotation @ offset[..., None])[..., 0]
        # Two halves of 1 / 1.6 of the size cover the parent (3DGS).
        values["log_scales"][fresh] = scales[source[fresh]].log() - torch.log(torch.tensor(1.6))
        replace_gaussians(gaussians, optimizer, values, source, len(stay))
        self.gradient, self.seen, self.radius = (mean.new_zeros(len(source)) for _ in range(3))


def replace_gaussians(
    gaussians: Gaussians, optimizer: Optimizer, values: dict[str, Tensor], source: Tensor, kept: int
) -> None:
    """Replace the learnable tensors by ``values``, whose rows come from the old rows ``source``.

    The first ``kept`` rows keep their Adam moments, the others start from zero.
    """
    for group, name in zip(optimizer.param_groups, NAMES, strict=True):
        old = group["params"][0]
        new = nn.Parameter(values[name].contiguous())
        state = optimizer.state.pop(old, {})
        for moment in ("exp_avg", "exp_avg_sq"):
            if moment in state:
                state[moment] = state[moment][source].clone()
                state[moment][kept:] = 0
        if state:
            optimizer.state[new] = state
        group["params"][0] = new
        setattr(gaussians, name, new)
