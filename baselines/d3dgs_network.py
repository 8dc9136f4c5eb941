"""The deformation network of D-3DGS: place and time of a canonical Gaussian to its change of place, turn and size."""

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from rewild4d.baselines.d3dgs_config import NetworkShape
from rewild4d.kernels.halves import available
from rewild4d.ours.pose import seed_linears

OUTPUTS = 10
"""Three of place, four of turn, three of size."""


def octave_code(values: Tensor, octaves: int) -> Tensor:
    """[x, sin 2^k x, cos 2^k x], k < octaves, no factor pi; [..., d] -> [..., d (1 + 2 octaves)]."""
    angles = (values[..., None, :] * 2.0 ** torch.arange(octaves).to(values)[:, None]).flatten(-2)
    return torch.cat((values, angles.sin(), angles.cos()), dim=-1)


class DeformationNetwork(nn.Module):
    """Layers of one width, the input once more after the fifth, and three linear heads (here one matrix).

    The time goes through a small network of its own. The heads start at zero, so that the first deformed Gaussians are
    the canonical ones.
    """

    def __init__(self, config: NetworkShape, generator: torch.Generator) -> None:
        super().__init__()
        self.config = config
        place, time = 3 * (1 + 2 * config.place_octaves), 1 + 2 * config.time_octaves
        width, given = config.width, place + config.time_features
        self.time_in = nn.Linear(time, config.time_width)
        self.time_out = nn.Linear(config.time_width, config.time_features)
        self.first, self.again = nn.Linear(given, width), nn.Linear(given, width)
        self.layers = nn.ModuleList(nn.Linear(width, width) for _ in range(config.depth - 1))
        self.heads = nn.Linear(width, OUTPUTS)
        seed_linears(self, generator)
        nn.init.zeros_(self.heads.weight)

    def forward(self, points: Tensor, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return changes at one time.

        Args:
            points: places scaled to about [-1, 1], no gradient flows to them, [n, 3].
            time: in about [-1, 1], scalar.

        Returns:
            Change of place [n, 3] in the same scale, of the quaternion [n, 4] and of the size [n, 3].
        """
        place = octave_code(points.detach(), self.config.place_octaves)
        moment = self.time_out(torch.relu(self.time_in(octave_code(time.reshape(1), self.config.time_octaves))))
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.half and available() and points.is_cpu):
            hidden = self._hidden(place, moment)
        move, turn, grow = self.heads(hidden.to(place)).split((3, 4, 3), dim=-1)
        return move, turn, grow

    def _hidden(self, place: Tensor, moment: Tensor) -> Tensor:
        """Compute what the heads read from codes of position [n, .] and of the one time [.], [n, width]."""
        hidden = torch.relu(_together(self.first, place, moment))
        for index, layer in enumerate(self.layers):
            hidden = layer(hidden)
            if index == self.config.skip:
                hidden = hidden + _together(self.again, place, moment)
            hidden = torch.relu(hidden)
        return hidden


def _together(layer: nn.Linear, place: Tensor, moment: Tensor) -> Tensor:
    """Apply a layer to [position, time] where the time is the same for all rows: its share becomes a bias."""
    columns = place.shape[1]
    bias = linear(moment, layer.weight[:, columns:], layer.bias)
    return linear(place, layer.weight[:, :columns], bias)
