"""The deformation network of D-3DGS: from position and time to offsets of position, orientation and scale."""

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from rewild4d.baselines.d3dgs_config import NetworkShape
from rewild4d.kernels.halves import available
from rewild4d.ours.pose import seed_linears

OUTPUTS = 10
"""Offsets of position (3), quaternion (4) and scale (3)."""


def octave_code(values: Tensor, octaves: int) -> Tensor:
    """Compute [x, sin 2^k x, cos 2^k x], k < octaves, without a factor pi; [..., d] -> [..., d (1 + 2 octaves)]."""
    angles = (values[..., None, :] * 2.0 ** torch.arange(octaves).to(values)[:, None]).flatten(-2)
    return torch.cat((values, angles.sin(), angles.cos()), dim=-1)


class DeformationNetwork(nn.Module):
    """Layers of one width with a skip connection from the input, and three linear heads (here one matrix).

    Time is encoded by a small network of its own. The heads start at zero, so that deformed Gaussians start as the
    canonical ones.
    """

    def __init__(self, config: NetworkShape, generator: torch.Generator) -> None:
        super().__init__()
        self.config = config
        position, time = 3 * (1 + 2 * config.place_octaves), 1 + 2 * config.time_octaves
        width, given = config.width, position + config.time_features
        self.time_in = nn.Linear(time, config.time_width)
        self.time_out = nn.Linear(config.time_width, config.time_features)
        self.first, self.again = nn.Linear(given, width), nn.Linear(given, width)
        self.layers = nn.ModuleList(nn.Linear(width, width) for _ in range(config.depth - 1))
        self.heads = nn.Linear(width, OUTPUTS)
        seed_linears(self, generator)
        nn.init.zeros_(self.heads.weight)

    def forward(self, points: Tensor, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return offsets at one time.

        Args:
            points: positions scaled to about [-1, 1], without their gradient, [n, 3].
            time: in about [-1, 1], scalar.

        Returns:
            Offsets of the position [n, 3] in the same scale, of the quaternion [n, 4] and of the scale [n, 3].
        """
        code = octave_code(points.detach(), self.config.place_octaves)
        encoded = self.time_out(torch.relu(self.time_in(octave_code(time.reshape(1), self.config.time_octaves))))
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.half and available() and points.is_cpu):
            hidden = self._hidden(code, encoded)
        means, quats, scales = self.heads(hidden.to(code)).split((3, 4, 3), dim=-1)
        return means, quats, scales

    def _hidden(self, points: Tensor, time: Tensor) -> Tensor:
        """Compute the features that the heads read, from codes of positions [n, .] and of one time [.]: [n, width]."""
        hidden = torch.relu(_joined(self.first, points, time))
        for index, layer in enumerate(self.layers):
            hidden = layer(hidden)
            if index == self.config.skip:
                hidden = hidden + _joined(self.again, points, time)
            hidden = torch.relu(hidden)
        return hidden


def _joined(layer: nn.Linear, points: Tensor, time: Tensor) -> Tensor:
    """Apply a layer to [position, time]; time is the same in all rows, so that its part is a bias."""
    columns = points.shape[1]
    bias = linear(time, layer.weight[:, columns:], layer.bias)
    return linear(points, layer.weight[:, :columns], bias)
