"""The deformation network of D-3DGS: place and time of a canonical Gaussian to its change of place, turn and size."""

import msgspec
import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from rewild4d.kernels.halves import available
from rewild4d.ours.config import Count, Whole
from rewild4d.ours.pose import seed_linears

OUTPUTS = 10
"""Three of place, four of turn, three of size."""


def octave_code(values: Tensor, octaves: int) -> Tensor:
    """[x, sin 2^k x, cos 2^k x], k < octaves, no factor pi; [..., d] -> [..., d (1 + 2 octaves)]."""
    angles = (values[..., None, :] * 2.0 ** torch.arange(octaves).to(values)[:, None]).flatten(-2)
    return torch.cat((values, angles.sin(), angles.cos()), dim=-1)


class NetworkShape(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sizes of the network; the defaults are the original's."""

    depth: Count = 8
    """Layers before the heads."""
    width: Count = 256
    """Of each: 10,000 Gaussians cost about 32 GFLOP a step at 256, 8 at 128, so short presets are narrower."""
    skip: Whole = 4
    """The input joins once more after this layer (counted from 0)."""
    place_octaves: Whole = 10
    """Of the position code."""
    time_octaves: Whole = 6
    """Of the time code."""
    time_width: Count = 256
    """Hidden width of the time's own network."""
    time_features: Count = 30
    """What it makes of the time."""
    half: bool = True
    """On a CPU that multiplies bfloat16 pairs the layers work in bfloat16, as the deformation of `ours` does: forward
    and backward about 20 ms for 50 (timed by hand; 6,000 Gaussians, width 128, one thread); the built-in tiger held
    out, standard, mean of three seeds that differ by .8: 20.3 dB for 20.0 (single precision, on another machine)."""


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
        """Changes at one time.

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
        """Codes of place [n, .] and of the one moment [.] -> what the heads read, [n, width]."""
        hidden = torch.relu(_together(self.first, place, moment))
        for index, layer in enumerate(self.layers):
            hidden = layer(hidden)
            if index == self.config.skip:
                hidden = hidden + _together(self.again, place, moment)
            hidden = torch.relu(hidden)
        return hidden


def _together(layer: nn.Linear, place: Tensor, moment: Tensor) -> Tensor:
    """A layer on [place, moment] where the moment is the same for all rows: its share becomes a bias."""
    columns = place.shape[1]
    bias = linear(moment, layer.weight[:, columns:], layer.bias)
    return linear(place, layer.weight[:, :columns], bias)
