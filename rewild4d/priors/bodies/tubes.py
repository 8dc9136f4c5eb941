"""Closed tubes lofted through elliptical sections by quadratic B-splines: constant topology and skinning weights."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor
from torch.nn.functional import normalize, pad

SKINNING_SOFTNESS = 0.12
"""Width of the blend between neighbouring bones, in bone lengths."""

Section = tuple[Tensor, Tensor, Tensor]
"""Centre [..., 3], half width and half height [...] of an ellipse across a tube."""


class Tube(NamedTuple):
    """A lofted tube: ring centres [..., r, 3], in-plane axes [..., r, 3] and half sizes [..., r]."""

    centers: Tensor
    across: Tensor
    upward: Tensor
    widths: Tensor
    heights: Tensor

    def points(self, segments: int, inset: Tensor | float = 0.0) -> Tensor:
        """Return points around each ring, moved inwards by ``inset`` ([..., r]), [..., r * segments, 3]."""
        angles = torch.arange(segments) * (2 * torch.pi / segments)
        rim = ((self.widths - inset)[..., None, None] * self.across[..., None, :]) * angles.cos()[:, None] + (
            (self.heights - inset)[..., None, None] * self.upward[..., None, :]
        ) * angles.sin()[:, None]
        return (self.centers[..., None, :] + rim).flatten(-3, -2)

    def mesh(self, segments: int) -> Tensor:
        """Return rings and one cap point at each end, [..., r * segments + 2, 3]."""
        return torch.cat((self.points(segments), self.centers[..., :1, :], self.centers[..., -1:, :]), dim=-2)

    def blobs(self, segments: int) -> tuple[Tensor, Tensor]:
        """Return round Gaussians whose common 50 % contour is close to the tube, [..., m, 3] and [..., m]."""
        sizes = 0.3 * torch.minimum(self.widths, self.heights)
        return self.points(segments, 2.1 * sizes), sizes.repeat_interleave(segments, dim=-1)


@cache
def spline(controls: int, rings: int) -> tuple[Tensor, Tensor]:
    """Return values and derivatives of a clamped quadratic B-spline at even parameters, each [rings, controls]."""
    degree = 2
    knots = np.concatenate((np.zeros(degree), np.linspace(0.0, 1.0, controls - degree + 1), np.ones(degree)))
    basis = BSpline(knots, np.eye(controls), degree)
    at = np.linspace(0.0, 1.0, rings)
    return torch.from_numpy(basis(at)).float(), torch.from_numpy(basis.derivative()(at)).float()


def loft(sections: Sequence[Section], relief: Tensor, rings: int) -> Tube:
    """Loft a tube through sections; relief is [..., c, 4]: logarithm of width and height, shift in y and z."""
    centers, sides, tops = zip(*sections, strict=True)
    controls = torch.stack(centers, -2) + pad(relief[..., 2:], (1, 0))
    widths, heights = torch.stack(sides, -1) * relief[..., 0].exp(), torch.stack(tops, -1) * relief[..., 1].exp()
    values, derivatives = spline(controls.shape[-2], rings)
    tangents = normalize(derivatives @ controls, dim=-1)
    across = normalize(torch.tensor((1.0, 0.0, 0.0)) - tangents * tangents[..., :1], dim=-1)
    upward = torch.linalg.cross(tangents, across)
    return Tube(values @ controls, across, upward, widths @ values.T, heights @ values.T)


@cache
def tube_quads(rings: int, segments: int) -> Tensor:
    """Return corners of the quadrilaterals of a tube with the vertices of `Tube.mesh`, [q, 4]."""
    ring, segment = torch.meshgrid(torch.arange(rings - 1), torch.arange(segments), indexing="ij")
    a = (ring * segments + segment).flatten()
    b = (ring * segments + (segment + 1) % segments).flatten()
    return torch.stack((a, b, b + segments, a + segments), 1)


@cache
def tube_faces(rings: int, segments: int) -> Tensor:
    """Return triangles of the same tube with its caps, [f, 3]."""
    quads, around = tube_quads(rings, segments), torch.arange(segments)
    following, last = (around + 1) % segments, (rings - 1) * segments
    start, end = torch.full_like(around, rings * segments), torch.full_like(around, rings * segments + 1)
    caps = torch.stack((start, following, around), 1), torch.stack((end, last + around, last + following), 1)
    return torch.cat((quads[:, (0, 1, 2)], quads[:, (0, 2, 3)], *caps))


def chain_weights(stations: Sequence[float], rings: int, bones: Sequence[int], first: float, count: int) -> Tensor:
    """Return smooth weights of rings along a chain of bones of ``count``, [rings, J].

    ``stations`` are the chain's coordinates of the sections: k to k + 1 is its k-th bone, counted from ``first``.
    """
    values, _ = spline(len(stations), rings)
    along = values @ torch.tensor(stations)
    middle = torch.arange(len(bones)) + first + 0.5
    outside = ((along[:, None] - middle).abs() - 0.5).clamp_min(-0.25)
    weights = torch.zeros(rings, count)
    weights[:, list(bones)] = torch.softmax(-outside / SKINNING_SOFTNESS, dim=1)
    return weights


def point(y: Tensor, z: Tensor, x: Tensor | None = None) -> Tensor:
    """Return points [..., 3] from their coordinates; x is zero where it is left out."""
    return torch.stack((torch.zeros_like(y) if x is None else x, y, z), dim=-1)
