"""What the browser draws at a moment, as arrays, computed when it is first asked for; and which moment a film is at."""

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import normalize

from rewild4d.transforms import quat_to_matrix
from rewild4d.types import Splats
from rewild4d.visualize.viewer.staging import Paint, Shape, Stage

MOST_BYTES = 512 * 1024**2
"""Of all moments that are kept: 500 of 20,000 Gaussians each."""


@dataclass(frozen=True)
class Moment:
    """Gaussians as the browser draws them: 52 bytes each.

    Attributes:
        centers: in the stage's frame, float32, [n, 3].
        covariances: float32, [n, 3, 3].
        rgbs: uint8, [n, 3].
        opacities: uint8, [n, 1].
    """

    centers: NDArray[np.float32]
    covariances: NDArray[np.float32]
    rgbs: NDArray[np.uint8]
    opacities: NDArray[np.uint8]

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in vars(self).values())


def pack(splats: Splats) -> Moment:
    """Turn Gaussians with RGB colours (k = 1) into arrays for the browser."""
    axes = quat_to_matrix(normalize(splats.quats, dim=-1)) * splats.scales[:, None, :]
    return Moment(
        splats.means.numpy(), (axes @ axes.mT).numpy(), _bytes(splats.colors[:, 0]), _bytes(splats.opacities[:, None])
    )


class Moments:
    """The moments of a run: each computed on first use and kept while there is room; the longest unused goes first."""

    def __init__(self, stage: Stage, most_bytes: int = MOST_BYTES) -> None:
        self.stage, self.most_bytes = stage, most_bytes
        self._kept: OrderedDict[tuple[float, Shape, Paint], Moment] = OrderedDict()

    @property
    def nbytes(self) -> int:
        """Bytes of what is kept."""
        return sum(moment.nbytes for moment in self._kept.values())

    def get(self, time: float, shape: Shape, paint: Paint) -> Moment:
        """Return what is drawn at a time in seconds; see `Stage.splats`."""
        key = (0.0 if shape == "canonical" else time, shape, paint)
        if key not in self._kept:
            made = pack(self.stage.splats(*key))
            while self._kept and self.nbytes + made.nbytes > self.most_bytes:
                self._kept.popitem(last=False)
            self._kept[key] = made
        self._kept.move_to_end(key)
        return self._kept[key]


class Clock:
    """Tell which moment a playing film is at, however long drawing takes; after the last it begins again.

    Args:
        times: of the moments in seconds, ascending.
        fps: frames a second: how long the last moment lasts.
    """

    def __init__(self, times: Sequence[float], fps: float) -> None:
        self._times, self._length = times, times[-1] - times[0] + 1 / fps
        self._position = self._since = 0.0

    def seek(self, moment: int, now: float) -> None:
        """Stand at a moment at the time ``now`` of the wall clock, in seconds."""
        self._position, self._since = self._times[moment] - self._times[0], now

    def moment(self, now: float, speed: float) -> int:
        """Move on at a speed from the last call to ``now``, and return the moment that is due."""
        self._position = (self._position + (now - self._since) * speed) % self._length
        self._since = now
        # Times are multiples of 1 / fps: a rounding error must not show a frame twice.
        return max(bisect_right(self._times, self._times[0] + self._position + 1e-6) - 1, 0)


def _bytes(values: torch.Tensor) -> NDArray[np.uint8]:
    return (values.clamp(0, 1) * 255).round().byte().numpy()
