"""Part-conditioned deformation: cross-attention from every Gaussian to the parts, beyond skinning."""

import torch
from torch import Tensor, nn

from rewild4d.kernels.simd import LANES
from rewild4d.ours.canonical import Posed
from rewild4d.ours.config import Deform as DeformConfig
from rewild4d.ours.fused.deformation import DEFORMATION, deform
from rewild4d.ours.fused.folding import Layers, fold
from rewild4d.ours.fused.queries import Scales
from rewild4d.ours.inputs import Scalar
from rewild4d.ours.pose import seed_linears
from rewild4d.transforms import quat_multiply
from rewild4d.types import OBJECT_DIAGONAL


class DeformNetwork(nn.Module):
    """Query: part mixture, position, orientation and size of a Gaussian; keys and values: the parts' features.

    The output layer starts at zero, so deformed Gaussians start as the skinned ones. Query and output projections of
    the attention are folded into the few keys and values, so a Gaussian costs two small matrix products.
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

    def forward(
        self,
        features: Tensor,
        weights: Tensor,
        anchors: Tensor | None,
        posed: Posed,
        strength: Scalar,
        offset: float = 0.0,
    ) -> Posed:
        """Deform skinned Gaussians.

        Args:
            features: part features F_J, [J, K].
            weights: skinning weights, no gradient, [n, J].
            anchors: of the parts, [J, D]; their mixture, or the weights where None, locates a Gaussian on the body.
            posed: skinned Gaussians; gradients pass through to them, but not through the query.
            strength: the ramp, in [0, 1].
            offset: of the draw of `config.sampled` Gaussians in the parameters' gradients, in [0, 1); torch sums over
                all.
        """
        weights = weights.detach()
        if DEFORMATION.takes(posed.means, owner=self) and (anchors is None or anchors.shape[1] <= LANES):
            return Posed(*self._fused(features, weights, anchors, posed, strength, offset))
        parts = weights if anchors is None else weights @ anchors
        query = torch.cat((parts, self._position_code(posed)), dim=-1)
        hidden = self._attend(query, features) + self.skip(query)
        hidden = hidden + self.down(torch.relu(self.up(torch.relu(hidden))))
        out = strength * self.out(torch.relu(hidden))
        rotation = torch.cat((torch.ones_like(out[:, :1]), out[:, 3:6]), dim=-1)
        return Posed(
            posed.means + self.config.reach * out[:, :3],
            quat_multiply(posed.quats, nn.functional.normalize(rotation, dim=-1)),
            posed.log_scales + self.config.max_log_scale * out[:, 6:].tanh(),
        )

    def _position_code(self, posed: Posed) -> Tensor:
        """Return position code, orientation (w >= 0) and log scale, detached, [n, 46]."""
        means, quats, log_scales = (tensor.detach() for tensor in posed)
        position = means * (2 / OBJECT_DIAGONAL)
        octaves = 2.0 ** torch.arange(self.config.frequencies, dtype=position.dtype, device=position.device)
        angles = (position[:, None] * octaves[:, None]).flatten(1)
        upright = torch.where(quats[:, :1] < 0, -quats, quats)
        return torch.cat((position, angles.sin(), angles.cos(), upright, log_scales), dim=-1)

    def _attend(self, query: Tensor, features: Tensor) -> Tensor:
        """Apply multi-head cross-attention over the parts, [n, inputs] and [J, K] -> [n, width]."""
        asked, asked_bias, mixed = self._attention(features)
        scores = torch.addmm(asked_bias, query, asked.T).view(len(query), self.config.heads, len(features))
        return torch.addmm(self.project.bias, scores.softmax(dim=-1).flatten(1), mixed.T)

    def _attention(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the attention over parts [J, K] as matrices: scores from a query [H J, inputs], their bias [H J], and
        hidden features from the shares [width, H J]."""
        heads, width = self.config.heads, self.config.width
        size = width // heads
        key = self.key(features).view(-1, heads, size)
        value = self.value(features).view(-1, heads, size)
        asked = torch.einsum("jhs,hsi->hji", key, self.query.weight.view(heads, size, -1)).flatten(0, 1)
        bias = torch.einsum("jhs,hs->hj", key, self.query.bias.view(heads, size)).flatten()
        mixed = torch.einsum("jhs,whs->whj", value, self.project.weight.view(width, heads, size)).flatten(1)
        return asked * size**-0.5, bias * size**-0.5, mixed

    def _fused(
        self, features: Tensor, weights: Tensor, anchors: Tensor | None, posed: Posed, strength: Scalar, offset: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        config = self.config
        layers = (self.query, self.skip, self.key, self.value, self.project, self.up, self.down, self.out)
        numbers = Layers(*(number for layer in layers for number in (layer.weight, layer.bias)))
        flat, sizes = fold(features, numbers, config.heads)
        parts = weights.shape[1] if anchors is None else anchors.shape[1]
        scales = Scales(
            2 / OBJECT_DIAGONAL, config.frequencies, parts, float(strength), config.reach, config.max_log_scale
        )
        return deform(flat, sizes, scales, config.half, weights, anchors, *posed, config.sampled, offset)
