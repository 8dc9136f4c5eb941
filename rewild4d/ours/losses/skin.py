"""Gaussians held to the skin that a fit starts from: what no camera sees keeps what the prior knows.

A method of ours, not of the paper. One camera does not see how far a Gaussian reaches along the line of sight, whether
it is opaque from behind, or which way it faces.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.losses.config import Skin
from rewild4d.ours.losses.regularizers import nearest_rows
from rewild4d.transforms import quat_to_matrix


@dataclass(frozen=True)
class StartingSkin:
    """Points of the surface that a fit starts from.

    Attributes:
        points: in the object frame at rest, [m, 3].
        normals: unit, [m, 3].
        log_radius: logarithm of a point's radius in the surface.
        information: what the clip says of each point (`evidence.information`), [m, 3, 3]; None holds all alike.
    """

    points: Tensor
    normals: Tensor
    log_radius: float
    information: Tensor | None = None

    @classmethod
    def of(cls, gaussians: Gaussians) -> "StartingSkin":
        """Return the skin of Gaussians that were placed on a surface and have not moved yet."""
        with torch.no_grad():
            log_radius = float(gaussians.log_scales[:, 0].mean())
            return cls(gaussians.means.clone(), third_axes(gaussians.quats), log_radius)

    def nearest(self, means: Tensor) -> Tensor:
        """Return the index of each centre's nearest point, [n, 3] -> [n]."""
        return nearest_rows(self.points, means)

    def holds(self, half: float) -> tuple[Tensor, Tensor]:
        """Return the firmness of each point and of its distance along the normal, both [m].

        `firmness_of` the smallest eigenvalue of the information, and of the information along the normal.
        """
        if self.information is None:
            return torch.ones_like(self.points[:, 0]), torch.ones_like(self.points[:, 0])
        least = torch.linalg.eigvalsh(self.information)[:, 0]
        along = torch.einsum("na,nab,nb->n", self.normals, self.information, self.normals)
        return firmness_of(least, half), firmness_of(along, half)


def firmness_of(known: Tensor, half: float) -> Tensor:
    """Return the weight of a hold on what images tell ``known`` of: h^2 / (h^2 + i^2), [...]."""
    return half**2 / (half**2 + known.square())


@dataclass(frozen=True)
class Bond:
    """What holds each Gaussian to the skin.

    Attributes:
        nearest: row of the skin, [n].
        firmness: weight of the hold, 1 where no frame sees the skin, near 0 where many do from all sides, [n].
        depth: the same for the distance along the normal, [n].
    """

    nearest: Tensor
    firmness: Tensor
    depth: Tensor

    @classmethod
    def at(cls, nearest: Tensor, holds: tuple[Tensor, Tensor]) -> "Bond":
        """Return what holds Gaussians at rows ``nearest`` [n] of a skin with such `StartingSkin.holds`."""
        return cls(nearest, *(hold[nearest] for hold in holds))


def third_axes(quats: Tensor) -> Tensor:
    """Return unit third axes of orientations, [n, 4] -> [n, 3]."""
    return quat_to_matrix(normalize(quats, dim=-1))[..., 2]


def disc_loss(log_scales: Tensor, opacities: Tensor, firmness: Tensor, log_radius: float, config: Skin) -> Tensor:
    """Compute the mean over Gaussians of how far they are from opaque discs of the starting size.

    The sum of: the squared difference of the first two log scales; the squared excess of the third over their mean less
    log `config.flat`; the squared excess of each over `config.growth` starting radii; the squared lack of opacity.

    Args:
        log_scales: [n, 3].
        opacities: [n].
        firmness: weight of each Gaussian (`Bond`), [n].
        log_radius: of the starting skin.
        config: bounds.
    """
    first, second, third = log_scales.unbind(-1)
    oval = (first - second).square()
    thick = (third - 0.5 * (first + second) + math.log(config.flat)).clamp_min(0).square()
    large = (log_scales - log_radius - math.log(config.growth)).clamp_min(0).square().sum(-1)
    return (firmness * (oval + thick + large + (1 - opacities).square())).mean()


def bind_loss(means: Tensor, quats: Tensor, skin: StartingSkin, bond: Bond, config: Skin) -> Tensor:
    """Compute the mean over Gaussians of their squared distance from the skin, in starting radii along its normal, and
    of one less the cosine between both normals.

    Beyond `config.reach` radii the distance costs the same everywhere, so that parts which the prior lacks are free.

    Args:
        means: [n, 3].
        quats: not normalised, [n, 4].
        skin: of the start.
        bond: of each Gaussian; `Bond.depth` weighs its distance, `Bond.firmness` its angle.
        config: bounds.
    """
    normals = skin.normals[bond.nearest]
    along = ((means - skin.points[bond.nearest]) * normals).sum(-1) * math.exp(-skin.log_radius)
    facing = (third_axes(quats) * normals).sum(-1)
    return (bond.depth * along.square().clamp(max=config.reach**2) + bond.firmness * (1 - facing)).mean()
