"""A procedural quadruped: a differentiable function from body proportions to a skinned mesh with the 20-bone layout.

Layout and numbering are 3D-Fauna's (design notes, FORMATS 4.4): body bones 0-3 run from the head to the middle of the
back, 4-7 from the tail tip to the middle; legs are front left 8-10, rear left 11-13, rear right 14-16, front right
17-19, each from foot to top. Joints follow from the proportions, and a leg starts at its shoulder or hip.

The mesh is five closed tubes (nose to tail tip, and four legs) lofted through elliptical control sections by quadratic
B-splines, so that topology and skinning weights are constant.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor
from torch.nn.functional import normalize, pad

from rewild4d.priors.proportions import Proportions
from rewild4d.transforms import mirror_camera, mirror_points, mirror_transforms
from rewild4d.types import OBJECT_DIAGONAL, Camera, Prior

PARENTS = (1, 2, 3, -1, 5, 6, 7, -1, 9, 10, 3, 12, 13, 7, 15, 16, 7, 18, 19, 3)
MIRROR = (0, 1, 2, 3, 4, 5, 6, 7, 17, 18, 19, 14, 15, 16, 11, 12, 13, 8, 9, 10)

BODY_RINGS, BODY_SEGMENTS = 48, 16
LEG_RINGS, LEG_SEGMENTS = 16, 10
SKINNING_SOFTNESS = 0.12
"""Width of the blend between neighbouring bones, in bone lengths."""


@dataclass(frozen=True)
class Template:
    """A quadruped at rest in object axes; leading dimensions are those of its proportions.

    Attributes:
        vertices: [..., n, 3].
        faces: counter-clockwise from outside, int64, [f, 3].
        weights: rows sum to one, [n, J].
        bones: start (the pivot) and end of each bone, [..., J, 2, 3].
        blobs: centres of a few hundred round Gaussians that fill the tubes, [..., m, 3].
        blob_sizes: their standard deviations, [..., m].
        blob_weights: rows sum to one, [m, J].
    """

    vertices: Tensor
    faces: Tensor
    weights: Tensor
    bones: Tensor
    blobs: Tensor
    blob_sizes: Tensor
    blob_weights: Tensor


class _Tube(NamedTuple):
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
def _spline(controls: int, rings: int) -> tuple[Tensor, Tensor]:
    """Return values and derivatives of a clamped quadratic B-spline at even parameters, each [rings, controls]."""
    degree = 2
    knots = np.concatenate((np.zeros(degree), np.linspace(0.0, 1.0, controls - degree + 1), np.ones(degree)))
    basis = BSpline(knots, np.eye(controls), degree)
    at = np.linspace(0.0, 1.0, rings)
    return torch.from_numpy(basis(at)).float(), torch.from_numpy(basis.derivative()(at)).float()


def _loft(sections: Sequence[tuple[Tensor, Tensor, Tensor]], relief: Tensor, rings: int) -> _Tube:
    """Loft a tube through sections: centre [..., 3], half width and half height [...]; relief is [..., c, 4]."""
    centers, sides, tops = zip(*sections, strict=True)
    controls = torch.stack(centers, -2) + pad(relief[..., 2:], (1, 0))
    widths, heights = torch.stack(sides, -1) * relief[..., 0].exp(), torch.stack(tops, -1) * relief[..., 1].exp()
    values, derivatives = _spline(controls.shape[-2], rings)
    tangents = normalize(derivatives @ controls, dim=-1)
    across = normalize(torch.tensor((1.0, 0.0, 0.0)) - tangents * tangents[..., :1], dim=-1)
    upward = torch.linalg.cross(tangents, across)
    return _Tube(values @ controls, across, upward, widths @ values.T, heights @ values.T)


@cache
def _tube_quads(rings: int, segments: int) -> Tensor:
    """Return corners of the quadrilaterals of a tube with the vertices of `_Tube.mesh`, [q, 4]."""
    ring, segment = torch.meshgrid(torch.arange(rings - 1), torch.arange(segments), indexing="ij")
    a = (ring * segments + segment).flatten()
    b = (ring * segments + (segment + 1) % segments).flatten()
    return torch.stack((a, b, b + segments, a + segments), 1)


@cache
def _tube_faces(rings: int, segments: int) -> Tensor:
    """Return triangles of the same tube with its caps, [f, 3]."""
    quads, around = _tube_quads(rings, segments), torch.arange(segments)
    following, last = (around + 1) % segments, (rings - 1) * segments
    start, end = torch.full_like(around, rings * segments), torch.full_like(around, rings * segments + 1)
    caps = torch.stack((start, following, around), 1), torch.stack((end, last + around, last + following), 1)
    return torch.cat((quads[:, (0, 1, 2)], quads[:, (0, 2, 3)], *caps))


def _point(y: Tensor, z: Tensor, x: Tensor | None = None) -> Tensor:
    return torch.stack((torch.zeros_like(y) if x is None else x, y, z), dim=-1)


def _spine(m: dict[str, Tensor]) -> list[Tensor]:
    """Return the nine spine joints from the nose to the tail tip, each [..., 3]."""
    half, high = m["body_length"] / 2, 0.45 * m["chest_height"]
    zero = torch.zeros_like(half)
    withers, hips = _point(high, half), _point(0.45 * m["hip_height"], -half)
    neck = _point(m["neck_angle"].sin(), m["neck_angle"].cos()) * m["neck_length"][..., None]
    head = _point(m["head_angle"].sin(), m["head_angle"].cos()) * m["head_length"][..., None]
    tail = _point(m["tail_angle"].sin(), -m["tail_angle"].cos()) * m["tail_length"][..., None]
    root = hips + _point(zero, -0.8 * m["hip_height"])
    return [
        withers + neck + head, withers + neck, withers + neck / 2, withers, _point(high, zero),
        hips, root, root + tail / 2, root + tail,
    ]  # fmt: skip


def _leg(m: dict[str, Tensor], end: str) -> list[Tensor]:
    """Return the four joints of a left leg from the top to the foot, each [..., 3]; ``end`` is "front" or "rear"."""
    side = 1.0 if end == "front" else -1.0
    length, stance = m[f"{end}_leg"], m[f"{end}_stance"]
    top = side * m["body_length"] / 2
    if end == "front":
        knee, hock = top - m["elbow_back"], top
    else:
        knee, hock = top + m["knee_forward"], top - m["hock_back"]
    zero = torch.zeros_like(length)
    return [
        _point(zero, top, stance),
        _point(-0.36 * length, knee, stance),
        _point(-0.68 * length, hock, stance),
        _point(-length, top - (0.0 if end == "front" else 0.5) * m["hock_back"], stance),
    ]


def _body_tube(m: dict[str, Tensor], joints: list[Tensor], relief: Tensor) -> _Tube:
    """Return the tube from nose to tail tip."""
    half, zero = m["body_length"] / 2, torch.zeros_like(m["body_length"])
    nose, poll, neck, withers, _, hips, root, tail, tip = joints
    snout = normalize(nose - poll, dim=-1)
    sections = (
        (nose, 0.55 * m["muzzle"], 0.55 * m["muzzle"]),
        (nose - 0.18 * snout * m["head_length"][..., None], m["muzzle"], m["muzzle"]),
        (0.5 * (nose + poll), 0.8 * m["head_width"], 0.85 * m["head_height"]),
        (poll + 0.12 * snout, 1.1 * m["head_width"], 1.15 * m["head_height"]),
        (poll - 0.25 * (poll - neck), m["neck_top"] * 0.85, m["neck_top"]),
        (neck, 0.5 * (m["neck_top"] + m["neck_base"]) * 0.8, 0.5 * (m["neck_top"] + m["neck_base"])),
        (withers + _point(-0.35 * m["chest_height"], 0.12 * half), 0.8 * m["chest_width"], 1.2 * m["neck_base"]),
        (_point(m["chest_drop"], 0.8 * half), m["chest_width"], m["chest_height"]),
        (_point(m["belly_drop"], zero), m["belly_width"], m["belly_height"]),
        (_point(zero, -0.75 * half), m["hip_width"], m["hip_height"]),
        (_point(zero, -half - 0.45 * m["hip_height"]), 0.75 * m["hip_width"], 0.75 * m["hip_height"]),
        (root, 1.3 * m["tail_base"], 1.3 * m["tail_base"]),
        (0.5 * (root + tail), m["tail_base"], m["tail_base"]),
        (tail + 0.25 * (tip - tail), m["tail_middle"], m["tail_middle"]),
        (tip, 0.4 * m["tail_middle"], 0.4 * m["tail_middle"]),
    )
    return _loft(sections, relief, BODY_RINGS)


BODY_STATIONS = (0.0, 0.2, 0.5, 0.95, 1.25, 2.0, 3.0, 3.25, 4.0, 4.75, 5.5, 6.0, 6.5, 7.25, 8.0)
"""Bone coordinate of each body section: k to k + 1 is the k-th bone from the nose (bones 0 1 2 3 7 6 5 4)."""
LEG_STATIONS = (-0.3, 0.1, 0.6, 1.0, 1.5, 2.0, 2.5, 2.85, 3.0)
"""Bone coordinate of each leg section: 0 to 1 is the top bone, below zero the body bone."""


def _leg_tube(m: dict[str, Tensor], joints: list[Tensor], end: str, relief: Tensor) -> _Tube:
    """Return the tube of a left leg, from inside the body to the toes."""
    top, knee, hock, foot = joints
    thigh, shank, paw = m[f"{end}_thigh"], m[f"{end}_shank"], m["paw"]
    lift, forward = _point(0.9 * thigh, torch.zeros_like(thigh)), _point(torch.zeros_like(paw), paw)
    sections = (
        (top + lift, 0.4 * thigh, 0.6 * thigh),
        (top, 0.8 * thigh, 1.3 * thigh),
        (0.45 * top + 0.55 * knee, 0.7 * thigh, 1.1 * thigh),
        (knee, 0.5 * (thigh + shank), 0.5 * (thigh + shank)),
        (0.5 * (knee + hock), 1.05 * shank, 1.15 * shank),
        (hock, shank, shank),
        (0.5 * (hock + foot), 0.9 * shank, 0.9 * shank),
        (foot, 0.9 * paw, paw),
        (foot + 0.7 * forward + 0.1 * (foot - hock), 0.5 * paw, 0.6 * paw),
    )
    return _loft(sections, relief, LEG_RINGS)


def _chain_weights(stations: tuple[float, ...], rings: int, bones: tuple[int, ...], first: float) -> Tensor:
    """Return smooth weights of rings along a chain of bones, [rings, J]; the chain's coordinate starts at ``first``."""
    values, _ = _spline(len(stations), rings)
    along = values @ torch.tensor(stations)
    middle = torch.arange(len(bones)) + first + 0.5
    outside = ((along[:, None] - middle).abs() - 0.5).clamp_min(-0.25)
    weights = torch.zeros(rings, len(PARENTS))
    weights[:, list(bones)] = torch.softmax(-outside / SKINNING_SOFTNESS, dim=1)
    return weights


@cache
def _skinning() -> tuple[tuple[Tensor, ...], Tensor]:
    """Return weights of each tube's rings, [r, J], of the body and the legs by number, and all faces, [f, 3]."""
    body = _chain_weights(BODY_STATIONS, BODY_RINGS, (0, 1, 2, 3, 7, 6, 5, 4), 0.0)
    tops = (10, 13, 16, 19)
    legs = tuple(_chain_weights(LEG_STATIONS, LEG_RINGS, (PARENTS[t], t, t - 1, t - 2), -1.0) for t in tops)
    faces, offset = [_tube_faces(BODY_RINGS, BODY_SEGMENTS)], BODY_RINGS * BODY_SEGMENTS + 2
    for leg in range(4):
        triangles = _tube_faces(LEG_RINGS, LEG_SEGMENTS)
        faces.append(offset + (triangles if leg < 2 else triangles.flip(1)))
        offset += LEG_RINGS * LEG_SEGMENTS + 2
    return (body, *legs), torch.cat(faces)


@cache
def quads() -> Tensor:
    """Return corners of the quadrilaterals of the whole mesh, its caps left out, int64, [q, 4]."""
    body, leg = _tube_quads(BODY_RINGS, BODY_SEGMENTS), _tube_quads(LEG_RINGS, LEG_SEGMENTS)
    first, each = BODY_RINGS * BODY_SEGMENTS + 2, LEG_RINGS * LEG_SEGMENTS + 2
    return torch.cat((body, *(first + k * each + leg for k in range(4))))


def quadruped(shape: Proportions | None = None, *, unit: bool = True) -> Template:
    """Build the template; differentiable in the proportions.

    Args:
        shape: body proportions, any leading dimensions; None is the average animal.
        unit: scale so that the bounding-box diagonal is `OBJECT_DIAGONAL`.

    Returns:
        The template, symmetric about x = 0, chest centre near the origin.
    """
    shape = shape or Proportions.average()
    m, reliefs = shape.measures(), shape.reliefs()
    spine = _spine(m)
    front, rear = _leg(m, "front"), _leg(m, "rear")
    body = _body_tube(m, spine, reliefs[0])
    left = [_leg_tube(m, front, "front", reliefs[1]), _leg_tube(m, rear, "rear", reliefs[2])]
    ring_weights, faces = _skinning()

    vertices = torch.cat(_with_right_legs([body.mesh(BODY_SEGMENTS), *(leg.mesh(LEG_SEGMENTS) for leg in left)]), -2)
    weights = [
        torch.cat((w.repeat_interleave(BODY_SEGMENTS if k == 0 else LEG_SEGMENTS, 0), w[:1], w[-1:]))
        for k, w in enumerate(ring_weights)
    ]
    blobs, sizes = zip(body.blobs(6), *(leg.blobs(3) for leg in left), strict=True)
    blob_weights = [w.repeat_interleave(6 if k == 0 else 3, 0) for k, w in enumerate(ring_weights)]

    segments = [(spine[k + 1], spine[k]) for k in range(4)] + [(spine[k - 1], spine[k]) for k in (8, 7, 6, 5)]
    legs = [front, rear, [mirror_points(j) for j in rear], [mirror_points(j) for j in front]]
    segments += [(leg[k], leg[k + 1]) for leg in legs for k in (2, 1, 0)]
    bones = torch.stack([torch.stack(pair, -2) for pair in segments], -3)

    scale = OBJECT_DIAGONAL / diagonal(vertices) if unit else torch.ones_like(vertices[..., 0, 0])
    return Template(
        vertices=vertices * scale[..., None, None],
        faces=faces,
        weights=torch.cat(weights),
        bones=bones * scale[..., None, None, None],
        blobs=torch.cat(_with_right_legs(blobs), -2) * scale[..., None, None],
        blob_sizes=torch.cat((*sizes, sizes[2], sizes[1]), -1) * scale[..., None],
        blob_weights=torch.cat(blob_weights),
    )


def _with_right_legs(parts: Sequence[Tensor]) -> list[Tensor]:
    """Append mirrored points, rear leg first, to those of the body and the left front and rear leg."""
    return [*parts, mirror_points(parts[2]), mirror_points(parts[1])]


def diagonal(vertices: Tensor) -> Tensor:
    """Return the length of the bounding-box diagonal, [..., n, 3] -> [...]."""
    return (vertices.amax(-2) - vertices.amin(-2)).norm(dim=-1)


def posed_prior(
    template: Template, transforms: Tensor, object_to_world: Tensor, cameras: Sequence[Camera], times: Tensor, *,
    name: str, provenance: str, quality: dict[str, float] | None = None, digest: str = "",
) -> Prior:  # fmt: skip
    """Make a prior of the posed template with the exact mirror image as its mirrored half; arguments as in `Prior`."""
    mirror = torch.tensor(MIRROR)
    return Prior(
        name=name, provenance=provenance, vertices=template.vertices, faces=template.faces, weights=template.weights,
        bones=template.bones, parents=torch.tensor(PARENTS), mirror=mirror, times=times,
        object_to_world=object_to_world, cameras=tuple(cameras), transforms=transforms,
        cameras_flip=tuple(map(mirror_camera, cameras)), transforms_flip=mirror_transforms(transforms, mirror),
        quality=quality or {}, digest=digest,
    )  # fmt: skip
