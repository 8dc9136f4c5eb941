"""Sample the surface that Gaussians draw: what images show of them, where `io.sampling` takes their centres."""

import math

import torch
from torch import Tensor

from rewild4d.harmonics import spiral
from rewild4d.io.sampling import OPACITY
from rewild4d.metrics.clouds import cell_rows, subsample
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import look_at, on_cpu
from rewild4d.types import Camera, Splats

VIEWS = 32
SIDE = 256
"""Pixels along a side of the images."""
DISTANCE = 10.0
"""Of the cameras from the middle, in radii of the Gaussians."""
ALPHA = 0.5
"""A pixel that is fainter shows no surface."""
SPREAD = 0.05
"""A pixel whose depths deviate by more (weighted standard deviation, in radii) lies on an outline between two parts."""
CELL = 0.01
"""Side of the grid's cells in which one point stays, in radii: a little over a pixel."""
RULE = f"points of the surface that Gaussians draw in {VIEWS} views of {SIDE} pixels"


@torch.no_grad()
def sample_drawn(splats: Splats, count: int, seed: int) -> Tensor:
    """Return points that lie evenly on the surface that is seen from all sides.

    A Gaussian reaches past its centre, so that centres of a well-drawn surface lie under it. The rule: cameras stand
    around the Gaussians, evenly over all directions. A pixel of at least half opacity has one point, at the mean depth
    of the Gaussians' centres by their weights in the image; none where these depths disagree. Of each cell of a grid
    one point stays, and of these so many are drawn. Where Gaussians are round, the points lie one standard deviation
    outside of their centres: so far they are seen.

    Args:
        splats: the Gaussians of one moment, activated values.
        count: most points.
        seed: the same seed draws the same points.

    Returns:
        float64, [m, 3], m <= count; [0, 3] where nothing is drawn.
    """
    splats = on_cpu(splats)
    solid = splats.means[splats.opacities >= OPACITY].double()
    if not len(solid):
        return solid
    middle = (solid.amin(0) + solid.amax(0)) / 2
    # A single Gaussian has no extent but its own.
    radius = float((solid - middle).norm(dim=-1).amax()) + 2 * float(splats.scales.amax())
    points = torch.cat([_seen(splats, camera, radius) for camera in _around(middle, radius)])
    rows = cell_rows((points - middle).numpy(), CELL * radius)
    return subsample(points[torch.from_numpy(rows)], count, seed)


def _around(middle: Tensor, radius: float) -> list[Camera]:
    """Return cameras on a sphere about ``middle`` [3], on a spiral that spaces them evenly."""
    focal = SIDE / 2 * math.sqrt(DISTANCE**2 - 1)  # the ball of this radius fills the image
    intrinsics = torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]], dtype=torch.float64)
    up = middle.new_tensor([0.0, 0.0, 1.0])  # no direction of the spiral lies on this axis
    eyes = middle + DISTANCE * radius * spiral(VIEWS)
    return [Camera(look_at(eye, middle, up), intrinsics, SIDE, SIDE) for eye in eyes]


def _seen(splats: Splats, camera: Camera, radius: float) -> Tensor:
    """Return the points of a view's pixels, in the world, float64, [k, 3]."""
    pose = camera.world_to_camera.double()
    # About the middle, in radii, so that single precision does for the squares.
    depths = (splats.means.double() @ pose[2, :3] + pose[2, 3]) / radius - DISTANCE
    features = torch.stack((depths, depths.square()), dim=-1).float()
    sums, alpha, _ = rasterize(
        splats.means, splats.quats, splats.scales, splats.opacities, features,
        pose[None].float(), camera.intrinsics[None].float(), SIDE, SIDE,
    )  # fmt: skip
    total = alpha[0, 0].double()
    mean, square = sums[0].double() / total.clamp_min(1e-6)
    rows, columns = ((total >= ALPHA) & (square - mean.square() <= SPREAD**2)).nonzero(as_tuple=True)
    depth = (mean[rows, columns] + DISTANCE) * radius
    pixels = torch.stack((columns + 0.5, rows + 0.5, torch.ones_like(depth)), dim=-1)
    in_camera = pixels @ torch.linalg.inv(camera.intrinsics.double()).T * depth[:, None]
    return (in_camera - pose[:3, 3]) @ pose[:3, :3]
