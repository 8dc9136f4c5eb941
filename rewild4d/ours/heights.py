"""The skin moved as a whole: each step also moves all Gaussians of a place along their normals alike.

A method of ours, not of the paper. An outline tells how thick a leg is only where the camera sees it from its edge.
What moves there takes along the sides that no camera sees, and the other leg. It is gradient descent on a smooth,
mirror-symmetric field of heights: the gradient is smoothed and scaled by one second moment, as Nicolet et al. do on
meshes ("Large Steps in Inverse Rendering of Geometry", 2021).
"""

from typing import Any

import torch
from torch import Tensor

from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.losses.skin import StartingSkin
from rewild4d.ours.skinning import cube_around, trilinear

BETAS = (0.9, 0.999)
"""Of the moments, as in Adam."""
VOXELS = 32
"""Along each axis."""
MARGIN = 1.2
"""Half-size of the cube over half the longest side of the skin."""


class Heights:
    """Moments of the gradient of heights over the skin, on a cube of voxels around it.

    Attributes:
        group: learning rate "lr", a number or a scalar tensor: the height of a step where the gradient is largest.
        rows: voxels around each point of the skin at the start, [m, 8].
        factors: their trilinear weights, [m, 8].
        first: smoothed gradient, x slowest, [R^3].
        second: smoothed square of its largest entry, scalar.
        count: steps taken, scalar.
    """

    def __init__(self, skin: StartingSkin, resolution: int = VOXELS) -> None:
        self.resolution = resolution
        self.group: dict[str, Any] = {"lr": 0.0}
        self.rows, self.factors = trilinear(skin.points, *cube_around(skin.points, MARGIN, resolution), resolution)
        self.first = skin.points.new_zeros(resolution**3)
        self.second, self.count = skin.points.new_zeros(()), skin.points.new_zeros(())

    @torch.no_grad()
    def step(self, gaussians: Gaussians, skin: StartingSkin, nearest: Tensor, share: Tensor) -> None:
        """Move the skin along its normals by the gradients of the centres, in place, and each centre with its point of
        the skin, whose row is in ``nearest`` [n]; a point moves by its ``share`` [m] of the height."""
        gradient, normals = gaussians.means.grad, skin.normals[nearest]
        assert gradient is not None, "`step` comes after backward"
        along = torch.zeros_like(skin.points[:, 0]).index_add_(0, nearest, (gradient * normals).sum(-1))
        spread = (self.factors * along[:, None]).flatten()
        total = torch.zeros_like(self.first).index_add_(0, self.rows.flatten(), spread)
        smooth = smoothed(total.view([self.resolution] * 3)).flatten()
        self.count += 1
        self.first.lerp_(smooth, 1 - BETAS[0])
        self.second.lerp_(smooth.square().max(), 1 - BETAS[1])
        scale = (self.second / (1 - BETAS[1] ** self.count)).sqrt().clamp_min(torch.finfo(smooth.dtype).tiny)
        field = self.first * (-self.group["lr"] / (1 - BETAS[0] ** self.count) / scale)
        heights = share[:, None] * (self.factors * field[self.rows]).sum(-1, keepdim=True)
        gaussians.means.data.add_(heights[nearest] * normals)
        skin.points.add_(heights * skin.normals)

    def state(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `restore` takes."""
        return self.first, self.second, self.count

    def restore(self, state: tuple[Tensor, Tensor, Tensor]) -> None:
        """Continue from `state`."""
        for own, saved in zip(self.state(), state, strict=True):
            own.copy_(saved)


def smoothed(grid: Tensor) -> Tensor:
    """Average a grid [R, R, R] with its mirror image along the first axis, then each voxel with its neighbours by
    weights 1/4, 1/2, 1/4 along each axis; voxels outside are 0."""
    grid = 0.5 * (grid + grid.flip(0))
    for axis in range(3):
        grid = grid.movedim(axis, 0)
        wider = torch.cat((torch.zeros_like(grid[:1]), grid, torch.zeros_like(grid[:1])))
        grid = (0.25 * wider[:-2] + 0.5 * wider[1:-1] + 0.25 * wider[2:]).movedim(0, axis)
    return grid
