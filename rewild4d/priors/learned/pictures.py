"""What the network is shown: sequences of small masked pictures, and the points that belong to them.

A picture is that of a camera that looks along the middle of its square crop, so that neither the focal length nor the
crop's place in the frame matter: only its opening does. Points are in that camera's axes (x right, y down, z ahead) in
units of half the crop's width at the depth of the animal's root.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rewild4d.priors.learned.points import OTHER_SIDE

SIZE = 96
"""Side of the pictures, pixels."""
MARGIN = 0.1
"""Of the crops around the mask's box, as a share of its side."""
LENGTH = 16
"""Frames of a sequence."""
LEVEL = np.diag((1.0, -1.0, -1.0))
"""Rotation that stands for that of an unknown camera, world (y up) -> camera, [3, 3]."""


@dataclass
class Examples:
    """A batch of sequences.

    Attributes:
        pictures: mask, and brightness inside it (zero mean, spread one half; all zero where unknown), [b, t, 2, s, s].
        rotations: world (y up, any heading) -> camera axes of each picture, [b, t, 3, 3].
        openings: half the crop's width at unit depth, [b, t].
        known: whether cameras are known; where not, rotations are those of one level camera, bool, [b].
        points: of the body, [b, t, L, 3].
    """

    pictures: Tensor
    rotations: Tensor
    openings: Tensor
    known: Tensor
    points: Tensor

    def mirrored(self) -> "Examples":
        """Return the sequences as a mirror shows them: left is right."""
        flip = self.points.new_tensor((-1.0, 1.0, 1.0))
        return Examples(
            self.pictures.flip(-1), flip[:, None] * self.rotations * flip, self.openings, self.known,
            self.points[..., OTHER_SIDE, :] * flip,
        )  # fmt: skip

    def chosen(self, rows: Tensor) -> "Examples":
        """Return some of the sequences, int64, [m]."""
        return Examples(*(value[rows] for value in vars(self).values()))


def joined(parts: list[Examples]) -> Examples:
    """Stack batches."""
    return Examples(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def looking_at(center: np.ndarray) -> np.ndarray:
    """Return the smallest rotation that turns the ray through (x, y, 1) to the z axis, [2] -> [3, 3]."""
    ray = np.append(center, 1.0) / np.sqrt(1 + center @ center)
    cross = np.array((ray[1], -ray[0], 0.0))
    skew = np.array(((0, 0, cross[1]), (0, 0, -cross[0]), (-cross[1], cross[0], 0)))
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + ray[2]))


def normalised(picture: np.ndarray) -> np.ndarray:
    """Return mask, and its brightness with zero mean and a spread of one half, [2, s, s]."""
    mask, bright = picture
    total = mask.sum() + 1e-6
    mean = bright.sum() / total
    away = bright - mean * mask
    spread = np.sqrt((away * away).sum() / total)
    return np.stack((mask, 0.5 * away / (spread + 0.03)))
