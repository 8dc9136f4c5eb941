"""See a reconstruction as after a similarity, without moving its Gaussians."""

from typing import NamedTuple

import torch
from torch import Tensor

from rewild4d.transforms import camera_in_object
from rewild4d.types import Camera


class Placement(NamedTuple):
    """How images of held-out views are drawn.

    Attributes:
        matrix: reconstruction -> world, a similarity, float64, [4, 4].
        note: stands with every score of these images.
        reason: why there are no such images, or "".
    """

    matrix: Tensor
    note: str = ""
    reason: str = ""

    def apply(self, points: Tensor) -> Tensor:
        """Map points of the reconstruction, float64, [n, 3] -> [n, 3]."""
        return points @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def camera(self, camera: Camera) -> Camera:
        """Return the camera that sees the reconstruction as ``camera`` sees it after the similarity."""
        return camera_in_object(camera, self.matrix)


IDENTITY = Placement(torch.eye(4, dtype=torch.float64))
