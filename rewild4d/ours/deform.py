"""The part-conditioned deformation: every Gaussian asks the parts, by cross-attention, how to move beyond skinning."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from rewild4d.kernels.arrays import fits
from rewild4d.ours.config import Deform as DeformConfig
from rewild4d.ours.fused.deformation import Reach, deform
from rewild4d.ours.fused.layers import layout, padded
from rewild4d.ours.pose import seed_linears
from rewild4d.transforms import quat_multiply
from rewild4d.types import OBJECT_DIAGONAL


class Posed(NamedTuple):
    """Geometry of Gaussians after skinning or deformation: [n, 3], [n, 4] (unit), log scales [n, 3]."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor


class DeformNetwork(nn.Module):
    """Query: part mixture, place, orientation and size of a Gaussian; keys and values: the parts' features.

    The output layer starts at zero, so the deformed Gaussians start as the skinned ones. Query and output projections
    of the attention are folded into the few keys and values, so a Gaussian costs two small matrix products.
    """

    def __init__(self, parts: int, features: int, config: DeformConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.config = config
        self.inputs = parts + 3 * (1 + 2 * config.frequencies) + 4 + 3
        width = config.width
        self.query, self.skip = nn.Linear(self.inputs, width), nn.Linear(self.inputs, width)
        self.key, self.value = nn.Linear(features, width), nn.Linear(features, width)
        self.project = nn.Linear(width, width)
        self.up, self.down, self.out = nn.Linear(width, width), nn.Linear(width, width), nn.Linear(width, 9)
        seed_linears(self, generator)
        nn.init.zeros_(self.out.weight)

    def forward(self, features: Tensor, parts: Tensor, posed: Posed, strength: float) -> Posed:
        """Deform skinned Gaussians.

        Args:
            features: part features F_J, [J, K].
            parts: part mixture of each Gaussian, weights times anchors, or the weights themselves, [n, D].
            posed: skinned Gaussians; gradients pass through to them, but not through the query.
            strength: the ramp, in [0, 1].

        Returns:
            Deformed Gaussians.
        """
        if fits(posed.means) and parts.shape[1] <= 16:
            return Posed(*self._fused(features, parts, posed, strength))
        query = torch.cat((parts, self._place(posed)), dim=-1)
        hidden = self._attend(query, features) + self.skip(query)
        hidden = hidden + self.down(torch.relu(self.up(torch.relu(hidden))))
        out = strength * self.out(torch.relu(hidden))
        turn = torch.cat((torch.ones_like(out[:, :1]), out[:, 3:6]), dim=-1)
        return Posed(
            posed.means + self.config.reach * out[:, :3],
            quat_multiply(posed.quats, nn.functional.normalize(turn, dim=-1)),
            posed.log_scales + self.config.max_log_scale * out[:, 6:].tanh(),
        )

    def _place(self, posed: Posed) -> Tensor:
        """Position code, orientation (w >= 0) and log scale, detached, [n, 46]."""
        means, quats, log_scales = (tensor.detach() for tensor in posed)
        place = means * (2 / OBJECT_DIAGONAL)
        octaves = 2.0 ** torch.arange(self.config.frequencies, dtype=place.dtype, device=place.device)
        angles = (place[:, None] * octaves[:, None]).flatten(1)
        upright = torch.where(quats[:, :1] < 0, -quats, quats)
        return torch.cat((place, angles.sin(), angles.cos(), upright, log_scales), dim=-1)

    def _attend(self, query: Tensor, features: Tensor) -> Tensor:
        """Multi-head cross-attention over the parts, [n, inputs] and [J, K] -> [n, width]."""
        asked, asked_bias, mixed = self._attention(features)
        shares = torch.addmm(asked_bias, query, asked.T).view(len(query), self.config.heads, -1).softmax(dim=-1)
        return torch.addmm(self.project.bias, shares.flatten(1), mixed.T)

    def _attention(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The attention over the parts as matrices: scores from a query [H J, inputs], their bias [H J], and the hidden
        features from the shares [width, H J]; from [J, K]."""
        heads, width = self.config.heads, self.config.width
        size = width // heads
        key = self.key(features).view(-1, heads, size)
        value = self.value(features).view(-1, heads, size)
        asked = torch.einsum("jhs,hsi->hji", key, self.query.weight.view(heads, size, -1)).flatten(0, 1)
        bias = torch.einsum("jhs,hs->hj", key, self.query.bias.view(heads, size)).flatten()
        mixed = torch.einsum("jhs,whs->whj", value, self.project.weight.view(width, heads, size)).flatten(1)
        return asked * size**-0.5, bias * size**-0.5, mixed

    def _fused(self, features: Tensor, parts: Tensor, posed: Posed, strength: float) -> tuple[Tensor, Tensor, Tensor]:
        asked, asked_bias, mixed = self._attention(features)
        sizes = layout(self.inputs, len(asked), self.config.width, self.config.heads)
        pairs = (
            (asked, asked_bias),
            (self.skip.weight, self.skip.bias + self.project.bias),
            (mixed, None),
            (self.up.weight, self.up.bias),
            (self.down.weight, self.down.bias),
            (self.out.weight, self.out.bias),
        )
        flat = torch.cat([piece for matrix, bias in pairs for piece in _padded(matrix, bias)])
        place = 2 / OBJECT_DIAGONAL
        config = self.config
        reach = Reach(place, config.frequencies, parts.shape[1], float(strength), config.reach, config.max_log_scale)
        return deform(flat, sizes, reach, parts, *posed)


def _padded(matrix: Tensor, bias: Tensor | None) -> tuple[Tensor, Tensor]:
    """A matrix and the bias behind it as `layers.Layout` has them, flat."""
    rows, columns = matrix.shape
    more = padded(rows) - rows
    wide = nn.functional.pad(matrix, (0, padded(columns) - columns, 0, more))
    return wide.flatten(), matrix.new_zeros(padded(rows)) if bias is None else nn.functional.pad(bias, (0, more))
