"""What a clip's images say of each Gaussian at the start of a fit: in which share of the frames, and from which sides,
it is seen. A method of ours, not of the paper."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.ours.canonical import Gaussians, Posed
from rewild4d.ours.symmetry import Key, Supervision
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import quat_to_matrix
from rewild4d.types import Camera, Prior

LEAST_COSINE = 0.1
"""Of a disc seen from its edge: the rasterizer widens it, so that its patch does not vanish."""
ONE_SIDE = math.radians(40.0)
"""Largest angle of a line of sight to their mean, in the object frame, of frames that see one side of an animal."""
NEAR = 2
"""Frames on either side that tell a pose too, since poses are smooth over time."""


@dataclass(frozen=True)
class Sighting:
    """One training view of the Gaussians, posed and not deformed.

    Attributes:
        key: of the view.
        share: of the training steps that see the view; all shares sum to 1.
        posed: centres, orientations and log scales in the object frame.
    """

    key: Key
    share: float
    posed: Posed

    @torch.no_grad()
    def seen(self, own: Gaussians, supervision: Supervision) -> tuple[Tensor, Tensor]:
        """Return the share of each Gaussian of ``own`` that is drawn, [n], and its line of sight in the frame at rest,
        unit, [n, 3]."""
        camera, posed = supervision.target(self.key).camera, self.posed
        sight = normalize(posed.means - camera.center.to(posed.means), dim=-1)
        local = torch.einsum("na,nab->nb", sight, own.rotations_to(normalize(posed.quats, dim=-1)))
        return visible_share(posed, own, camera), local


def turn(centers: Tensor, positions: Tensor) -> Tensor:
    """Return how well the frames beside each one tell the depth that it does not tell itself, in [0, 1], [T].

    The mean of sin^2 of the angle between its line of sight, to the origin of the object frame, and those of the frames
    at most `NEAR` away: 0 for a camera that stands still before an animal that does not turn, 0.07 where it turns by 10
    degrees a frame and 0.5 by 30.

    Args:
        centers: of the cameras in the object frame, float64, [T, 3].
        positions: of the frames in the video (`symmetry.frame_positions`), float64, [T].
    """
    sights = normalize(centers, dim=-1)
    squares = (1 - (sights @ sights.t()).square()).clamp_min(0)
    gaps = (positions[:, None] - positions).abs()
    near = ((gaps > 0) & (gaps < NEAR + 0.5)).double()
    return (squares * near).sum(1) / near.sum(1).clamp_min(1)


def sees_one_side(prior: Prior) -> bool:
    """Tell whether all frames see the animal from one side; one that turns before a camera shows others."""
    sights = normalize(torch.stack([camera.center.double() for camera in prior.cameras]), dim=-1)
    return bool((sights @ normalize(sights.mean(0), dim=0)).min() > math.cos(ONE_SIDE))


def pull_shares(supervision: Supervision, limit: float) -> list[float]:
    """Return the share of the pull to the prior's pose that is left to each frame: ``limit`` over what the frames
    beside it tell (`turn`), at most 1; 1 everywhere where the limit is 0."""
    if not limit:
        return [1.0] * supervision.frames
    cameras = [supervision.target(Key(1, 1, frame)).camera for frame in range(supervision.frames)]
    told = turn(torch.stack([camera.center.cpu().double() for camera in cameras]), supervision.positions)
    return (limit / told.clamp_min(limit)).tolist()


def training_views(supervision: Supervision, mirrored: float) -> Iterator[tuple[Key, float]]:
    """List the views that a fit is trained on, and the share of the steps that sees each."""
    for view, share in ((1, 1 - mirrored), (-1, mirrored)):
        frames = supervision.frames_of(view) if share else []
        for frame in frames:
            yield Key(view, view, frame), share / len(frames)  # under other keys the pose may not be trained


@torch.no_grad()
def information(own: Gaussians, views: Iterable[Sighting], supervision: Supervision) -> Tensor:
    """Return what the clip's images say of each Gaussian's place, in the frame at rest, [n, 3, 3].

    The mean over the training views of v (I - d d^T), with d the line of sight and v the share of the Gaussian that is
    drawn. An image tells a place across the line of sight and not along it, so that x^T M x is the share of the frames
    that tell the place along a unit vector x; M is 0 where no frame sees the Gaussian, and its smallest eigenvalue is 0
    where all see it from one side.

    Args:
        own: canonical Gaussians.
        views: of them.
        supervision: with the views' cameras.
    """
    total = own.means.new_zeros(len(own), 3, 3)
    for sighting in views:
        total += sighting.share * told(*sighting.seen(own, supervision))
    return total


def told(visible: Tensor, sight: Tensor) -> Tensor:
    """Return v (I - d d^T), [..., 3, 3], of shares v [...] that are drawn and lines of sight d [..., 3]."""
    across = torch.eye(3).to(sight) - sight[..., :, None] * sight[..., None, :]
    return visible[..., None, None] * across


@torch.no_grad()
def visible_share(posed: Posed, gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return which share of each Gaussian is drawn in an image, 0 to 1, [n].

    What a Gaussian adds to the image, over the area of its disc there: pi times its first two scales.

    Args:
        posed: where the Gaussians are in the image's frame.
        gaussians: whose opacities and bounds of scales they have.
        camera: of the image.
    """
    quats, scales = normalize(posed.quats, dim=-1), gaussians.scales(posed.log_scales)
    with torch.enable_grad():
        # The image is linear in the colours: the gradient of its sum is what each Gaussian adds.
        ones = torch.ones(len(scales), 1, device=scales.device, requires_grad=True)
        image, _, _ = rasterize(
            posed.means, quats, scales, gaussians.opacities(), ones,
            camera.world_to_camera[None], camera.intrinsics[None], camera.width, camera.height,
        )  # fmt: skip
        (drawn,) = torch.autograd.grad(image.sum(), ones)
    _, depth = camera.project(posed.means)
    sight = normalize(posed.means - camera.center.to(posed.means), dim=-1)
    cosine = (sight * quat_to_matrix(quats)[..., 2]).sum(-1).abs().clamp_min(LEAST_COSINE)
    pixels = camera.intrinsics[0, 0] * camera.intrinsics[1, 1] / depth.square()
    return (drawn[:, 0] / (math.pi * scales[:, 0] * scales[:, 1] * cosine * pixels)).clamp(0.0, 1.0)
